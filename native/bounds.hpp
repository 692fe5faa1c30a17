// Sizes and error bounds of the kernel, each once. `core/backprojection/engines/native.py` predicts with the
// same numbers; contract.cpp exports them and a test compares the two. docs/theory/engine.md derives them.
#pragma once
#include <cstdint>

namespace apertura {

constexpr int64_t kPatchSide = 16;  // pixels along a patch
constexpr int64_t kBlockSide = 4;   // pixels along a block, whose paths are one polynomial
constexpr int64_t kBatch = 8;       // pulses whose paths are computed together
constexpr int64_t kTaps = 16;       // of a table's filters
constexpr int64_t kWindow = 16;     // table cells that one look-up can reach
constexpr int64_t kEchoTaps = 8;    // samples that make an echo at a single place
constexpr int64_t kEchoDegree = 4;  // of the polynomials that weigh them
constexpr int64_t kTermTaps = 24;   // samples that make one in float64
// A path may lie half a cell beyond the cell it is rounded to; the rest is what float32 may err.
constexpr float kWindowMargin = 0.51f;

// Largest error of one leg's series of |w + d| (engine.md, "Paths"), whose order n is at most
// max |P_{n-2} - P_n| / (2n - 1) times d^n / R^(n-1): 1/(3 sqrt 3) for n = 3, 1/8 for 4, 0.083 for 5. D is the largest
// distance of a block's centre from the patch's origin, delta that of a pixel from its block's centre.
constexpr float kFifthOrder = 0.14f;            // D^5/R^4, with room for higher orders; the gradient adds delta D^4/R^4
constexpr float kThirdOrder = 0.19f;            // delta^3/R^2
constexpr float kSharedCurvatureError = 0.58f;  // D delta^2/R^2: three such terms, 1/sqrt 3
constexpr float kOwnCurvatureError = 0.075f;    // D^2 delta^2/R^3: of six terms of 1/8 all but a tenth is in (5a)

// Second-order terms move a pixel of a block by at most 1.5^2 times their coefficients; those of the origin stand for
// all of the patch, with a factor of two.
constexpr float kCurvatureSpan = 4.5f;

// Antenna weights are a polynomial where, between the nodes of a patch and relative to the beam's peak, they change and
// curve (second difference) by no more than this.
constexpr float kWeightChange = 0.12f, kWeightCurvature = 0.025f;

// At the edge of a sector the place of a pixel is of second order in its block where what is left stays below this
// part of the edge's width.
constexpr float kSectorBend = 2e-3f;

}  // namespace apertura
