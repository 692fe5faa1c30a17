// A patch: up to 16 x 16 pixels, described by a plane and a height above it along one fitted direction.
#pragma once
#include "job.hpp"

namespace apertura {

constexpr int kSide = 16;    // pixels along a patch
constexpr int kBlocks = 16;  // blocks of 4 x 4 pixels in it
constexpr int kPixels = kSide * kSide;

// First row and column of a block in its patch: four blocks are a group of 8 x 8 pixels, four groups a patch.
constexpr int top(int block) { return block / 8 * 8 + block / 2 % 2 * 4; }
constexpr int left(int block) { return block / 4 % 2 * 8 + block % 2 * 4; }

// Half of what `count` pixels span, in pixels.
constexpr float half(int count) { return count > 1 ? 0.5f * float(count - 1) : 0.5f; }

// Lengths in cells but for `origin`. Lanes are counted row by row of a block.
struct alignas(64) Patch {
  float along_x[kBlocks], along_y[kBlocks], height[kBlocks];  // centre of each block: pixels, pixels, cells
  float square[kBlocks];                                      // squared distance of that centre from the origin
  float dot_x[kBlocks], dot_y[kBlocks], dot_h[kBlocks];       // its products with step_x, step_y and up
  float rise[kPixels];                                        // height of each pixel above its block's, block by block
  double origin[3], step_x[3], step_y[3], up[3];
  float xx, xy, yy, xh, yh;                                   // products of step_x, step_y and up
  float reach, inner, roughest, tallest;                      // largest centre distance, pixel offset in a block, |rise|,
                                                              // height above the plane
  int64_t row, column;                                        // of the first pixel
  int rows, columns;                                          // pixels present
  bool present[kBlocks];                                      // which blocks hold any
  bool terrain;                                               // heights matter
  bool crooked;                                               // no plane with heights describes it: exact only
};

// `bend_cells`: largest distance from the description that still counts as described.
void fit(const ApertureJob& job, int64_t row, int64_t column, double bend_cells, Patch& patch);

}  // namespace apertura
