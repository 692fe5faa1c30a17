// Patch of up to 16 x 16 pixels, described by a plane and heights above it along one fitted direction.
#pragma once
#include "job.hpp"

// Functions are static: kernel.cpp is compiled for several instruction sets, and the linker must never merge the
// copies.
namespace apertura {

constexpr int64_t kBlocks = 16;  // blocks of 4 x 4 pixels in a patch
constexpr int64_t kPixels = kPatchSide * kPatchSide;

// First row and column of a block in its patch: four blocks form a group of 8 x 8 pixels, four groups a patch.
static constexpr int64_t block_row(int64_t block) { return block / 8 * 8 + block / 2 % 2 * kBlockSide; }
static constexpr int64_t block_column(int64_t block) { return block / 4 % 2 * 8 + block % 2 * kBlockSide; }

// Row and column of a pixel in its patch; pixels are stored block by block.
static constexpr int64_t pixel_row(int64_t slot) { return block_row(slot / 16) + slot % 16 / kBlockSide; }
static constexpr int64_t pixel_column(int64_t slot) { return block_column(slot / 16) + slot % kBlockSide; }

// Half the span of `count` pixels, in pixels.
static constexpr float half_span(int64_t count) { return count > 1 ? 0.5f * float(count - 1) : 0.5f; }

// Lengths are in cells, except `origin` in metres. Pixel (i, j) is at origin + j step_x + i step_y + height up, with i
// and j counted from the centre of the patch; pixels are stored block by block, and row by row in a block.
struct alignas(64) Patch {
  float along_x[kBlocks], along_y[kBlocks], height[kBlocks];   // centre of each block: pixels, pixels, cells
  float square[kBlocks];                                       // |d|^2: squared distance of the centre from the origin
  float dot_x[kBlocks], dot_y[kBlocks], dot_h[kBlocks];        // d . step_x, d . step_y and d . up
  float rise[kPixels];                                         // h': height of each pixel above its block
  float moved[kPixels];                                        // sector centre of each pixel minus that of the job
  float moved_b[kBlocks], moved_x[kBlocks], moved_y[kBlocks];  // `moved` at each block's centre, and its slopes
  float moved_mean, moved_reach, moved_bend;  // mean over the patch; largest deviations from it and from block slopes
  double origin[3], step_x[3], step_y[3], up[3];
  float xx, xy, yy, xh, yh;         // products of step_x, step_y and up
  float block_reach, pixel_reach;   // D and delta: largest |d|, largest distance of a pixel from its block's centre
  float fifth, third, shared, own;  // errors of a one-way path's series (engine.md, "Paths"), without powers of 1/R
  float rise_max, height_max;       // largest |rise|, and largest height above or below the plane
  int64_t row, column;              // of the first pixel
  int64_t rows, columns;            // number of pixels
  bool present[kBlocks];            // blocks that contain pixels
  bool terrain;                     // heights exceed the tolerance
  bool irregular;                   // not described by a plane with heights: exact paths only
};

// Returns true if a slot of the block-by-block storage is a pixel of the patch.
static inline bool holds(const Patch& patch, int64_t slot) {
  return pixel_row(slot) < patch.rows && pixel_column(slot) < patch.columns;
}

// Fits the description of the patch whose first pixel is at `row`, `column`; `deviation_cells` is the tolerated
// distance of a pixel from this description.
void fit(const ApertureJob& job, int64_t row, int64_t column, double deviation_cells, Patch& patch);

}  // namespace apertura
