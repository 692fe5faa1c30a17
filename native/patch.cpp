#include "patch.hpp"

#include <cmath>
#include <cstring>
#include <initializer_list>

namespace apertura {
namespace {

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Least-squares plane through the pixels; offsets from its origin are left in `rest`, in cells.
void fit_plane(const ApertureJob& job, Patch& patch, double rest[kPixels][3]) {
  const double* corner = job.pixels + 3 * (patch.row * job.columns + patch.column);
  const double mid_y = 0.5 * (patch.rows - 1), mid_x = 0.5 * (patch.columns - 1);
  double mean[3] = {}, slope_x[3] = {}, slope_y[3] = {};
  for (int i = 0; i < patch.rows; i++)
    for (int j = 0; j < patch.columns; j++)
      for (int axis = 0; axis < 3; axis++) {
        const double offset = (corner[3 * (i * job.columns + j) + axis] - corner[axis]) * job.cells_per_metre;
        rest[i * kSide + j][axis] = offset;
        mean[axis] += offset;
        slope_x[axis] += (j - mid_x) * offset;
        slope_y[axis] += (i - mid_y) * offset;
      }
  const double count = patch.rows * patch.columns;
  const double spread_x = count * (patch.columns * patch.columns - 1.0) / 12;
  const double spread_y = count * (patch.rows * patch.rows - 1.0) / 12;
  for (int axis = 0; axis < 3; axis++) {
    mean[axis] /= count;
    patch.origin[axis] = corner[axis] + mean[axis] / job.cells_per_metre;
    patch.step_x[axis] = spread_x > 0 ? slope_x[axis] / spread_x : 0;
    patch.step_y[axis] = spread_y > 0 ? slope_y[axis] / spread_y : 0;
  }
  for (int i = 0; i < patch.rows; i++)
    for (int j = 0; j < patch.columns; j++)
      for (int axis = 0; axis < 3; axis++)
        rest[i * kSide + j][axis] -=
            mean[axis] + (j - mid_x) * patch.step_x[axis] + (i - mid_y) * patch.step_y[axis];
}

// The direction in which the pixels leave the plane: the vertical, for terrain. Fills up, terrain, crooked, height.
void fit_height(Patch& patch, double bend_cells, const double rest[kPixels][3], double height[kPixels]) {
  double moment[3][3] = {}, largest = 0;
  for (int i = 0; i < patch.rows; i++)
    for (int j = 0; j < patch.columns; j++) {
      const double* r = rest[i * kSide + j];
      const double square = dot(r, r);
      largest = square <= largest ? largest : square;  // keeps a NaN
      for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) moment[a][b] += r[a] * r[b];
    }
  patch.terrain = !(largest <= bend_cells * bend_cells);
  patch.crooked = false;
  std::memset(patch.up, 0, sizeof patch.up);
  if (!patch.terrain) return;
  int start = 0;
  for (int a = 1; a < 3; a++)
    if (moment[a][a] > moment[start][start]) start = a;
  double up[3] = {moment[start][0], moment[start][1], moment[start][2]};
  for (int turn = 0; turn < 4; turn++) {
    const double length = std::sqrt(dot(up, up));
    for (double& value : up) value /= length;
    const double next[3] = {dot(moment[0], up), dot(moment[1], up), dot(moment[2], up)};
    std::memcpy(up, next, sizeof up);
  }
  const double length = std::sqrt(dot(up, up));
  for (int axis = 0; axis < 3; axis++) patch.up[axis] = up[axis] / length;
  double aside = 0;
  for (int i = 0; i < patch.rows; i++)
    for (int j = 0; j < patch.columns; j++) {
      const double* r = rest[i * kSide + j];
      height[i * kSide + j] = dot(r, patch.up);
      const double square = dot(r, r) - height[i * kSide + j] * height[i * kSide + j];
      aside = square <= aside ? aside : square;
    }
  patch.crooked = !(aside <= bend_cells * bend_cells);
}

// Centre and height of a block, and how far its pixels lie from them.
void describe_block(Patch& patch, int block, const double height[kPixels]) {
  const int above = top(block), before = left(block);
  double sum = 0;
  int count = 0;
  for (int lane = 0; patch.terrain && lane < 16; lane++) {
    const int i = above + lane / 4, j = before + lane % 4;
    if (i >= patch.rows || j >= patch.columns) continue;
    sum += height[i * kSide + j];
    count++;
  }
  const double level = count ? sum / count : 0;
  const double x = before + 1.5 - 0.5 * (patch.columns - 1), y = above + 1.5 - 0.5 * (patch.rows - 1);
  double centre[3];
  for (int axis = 0; axis < 3; axis++)
    centre[axis] = x * patch.step_x[axis] + y * patch.step_y[axis] + level * patch.up[axis];
  patch.along_x[block] = float(x), patch.along_y[block] = float(y), patch.height[block] = float(level);
  patch.square[block] = float(dot(centre, centre));
  patch.dot_x[block] = float(dot(centre, patch.step_x));
  patch.dot_y[block] = float(dot(centre, patch.step_y));
  patch.dot_h[block] = float(dot(centre, patch.up));
  patch.reach = std::fmax(patch.reach, std::sqrt(patch.square[block]));
  for (int lane = 0; patch.terrain && lane < 16; lane++) {
    const int i = above + lane / 4, j = before + lane % 4;
    if (i >= patch.rows || j >= patch.columns) continue;
    const double rise = height[i * kSide + j] - level;
    patch.rise[block * 16 + lane] = float(rise);
    patch.roughest = std::fmax(patch.roughest, float(std::fabs(rise)));
    patch.tallest = std::fmax(patch.tallest, float(std::fabs(height[i * kSide + j])));
  }
}

}  // namespace

void fit(const ApertureJob& job, int64_t row, int64_t column, double bend_cells, Patch& patch) {
  std::memset(static_cast<void*>(&patch), 0, sizeof patch);
  patch.row = row, patch.column = column;
  patch.rows = int(job.rows - row < kSide ? job.rows - row : kSide);
  patch.columns = int(job.columns - column < kSide ? job.columns - column : kSide);
  double rest[kPixels][3], height[kPixels] = {};
  fit_plane(job, patch, rest);
  fit_height(patch, bend_cells, rest, height);
  patch.xx = float(dot(patch.step_x, patch.step_x));
  patch.xy = float(dot(patch.step_x, patch.step_y));
  patch.yy = float(dot(patch.step_y, patch.step_y));
  patch.xh = float(dot(patch.step_x, patch.up));
  patch.yh = float(dot(patch.step_y, patch.up));
  for (int block = 0; block < kBlocks; block++) {
    patch.present[block] = top(block) < patch.rows && left(block) < patch.columns;
    if (patch.present[block]) describe_block(patch, block, height);
  }
  // The corner of a block, and a pixel's height as if it lay crosswise to it or along it.
  for (int side = -1; side <= 1; side += 2) {
    double corner[3];
    for (int axis = 0; axis < 3; axis++) corner[axis] = 1.5 * (patch.step_x[axis] + side * patch.step_y[axis]);
    patch.inner = std::fmax(patch.inner, float(std::sqrt(dot(corner, corner))));
  }
  patch.inner += patch.roughest;
  // A block without pixels stands where one with pixels is, so that it never decides about its group.
  for (int block = 0; block < kBlocks; block++)
    if (!patch.present[block]) {
      const int like = patch.present[block / 4 * 4] ? block / 4 * 4 : 0;
      for (float* array : {patch.along_x, patch.along_y, patch.height, patch.square, patch.dot_x, patch.dot_y, patch.dot_h})
        array[block] = array[like];
    }
}

}  // namespace apertura
