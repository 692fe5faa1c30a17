// Sizes and error bounds of the kernel. `core/backprojection/engines/native.py` uses the same numbers for predictions;
// contract.cpp exports them, and a test compares both. docs/theory/engine.md derives them.
#pragma once
#include <cstdint>

namespace apertura {

constexpr int64_t kPatchSide = 16;  // pixels along a patch
constexpr int64_t kBlockSide = 4;   // pixels along a block; one polynomial describes the paths of a block
constexpr int64_t kBatch = 8;       // pulses whose paths are computed together
constexpr int64_t kTaps = 16;       // taps of a table's filters
constexpr int64_t kWindow = 16;     // table cells within reach of one look-up
constexpr int64_t kEchoTaps = 8;    // samples that interpolate the echo at a single point
constexpr int64_t kEchoDegree = 4;  // degree of the polynomials of interpolation weights
constexpr int64_t kTermTaps = 24;   // samples that interpolate an echo in float64
// A path may be half a cell from the cell it is rounded to; the remainder covers errors of float32.
constexpr float kWindowMargin = 0.51f;

// Largest error of the series of a one-way path |w + d| (engine.md, "Paths"), whose order n is at most
// max |P_{n-2} - P_n| / (2n - 1) times d^n / R^(n-1): 1/(3 sqrt 3) for n = 3, 1/8 for 4, 0.083 for 5. D is the largest
// distance of a block's centre from the patch's origin, delta that of a pixel from its block's centre.
constexpr float kFifthOrder = 0.14f;            // D^5/R^4, with room for higher orders; the gradient adds delta D^4/R^4
constexpr float kThirdOrder = 0.19f;            // delta^3/R^2
constexpr float kSharedCurvatureError = 0.58f;  // D delta^2/R^2: three such terms, 1/sqrt 3
constexpr float kOwnCurvatureError = 0.075f;    // D^2 delta^2/R^3: a tenth of six terms of 1/8; (5a) contains the rest

// Second-order terms change the path of a pixel in a block by at most 1.5^2 times their coefficients; those of the
// origin bound those of the whole patch with a factor of two.
constexpr float kCurvatureSpan = 4.5f;

// Largest first and second differences of antenna weights between the nodes of a patch, relative to the beam's peak,
// for which a polynomial is used.
constexpr float kWeightChange = 0.12f, kWeightCurvature = 0.025f;

// Largest residual of the second-order expansion of s inside a block at the edge of a sector, relative to the width of
// the edge.
constexpr float kSectorBend = 2e-3f;

}  // namespace apertura
