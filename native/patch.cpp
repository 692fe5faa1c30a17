#include "patch.hpp"

#include <cmath>
#include <cstring>
#include <initializer_list>

#include "centre.hpp"

namespace apertura {
namespace {

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Least-squares plane through the pixels; `rest` receives the residuals in cells.
void fit_plane(const ApertureJob& job, Patch& patch, double rest[kPixels][3]) {
  const double* corner = job.pixels + 3 * (patch.row * job.columns + patch.column);
  const double mid_y = 0.5 * (patch.rows - 1), mid_x = 0.5 * (patch.columns - 1);
  double mean[3] = {}, slope_x[3] = {}, slope_y[3] = {};
  for (int64_t i = 0; i < patch.rows; i++)
    for (int64_t j = 0; j < patch.columns; j++)
      for (int64_t axis = 0; axis < 3; axis++) {
        const double offset = (corner[3 * (i * job.columns + j) + axis] - corner[axis]) * job.cells_per_metre;
        rest[i * kPatchSide + j][axis] = offset;
        mean[axis] += offset;
        slope_x[axis] += (j - mid_x) * offset;
        slope_y[axis] += (i - mid_y) * offset;
      }
  const double count = patch.rows * patch.columns;
  const double spread_x = count * (patch.columns * patch.columns - 1.0) / 12;
  const double spread_y = count * (patch.rows * patch.rows - 1.0) / 12;
  for (int64_t axis = 0; axis < 3; axis++) {
    mean[axis] /= count;
    patch.origin[axis] = corner[axis] + mean[axis] / job.cells_per_metre;
    patch.step_x[axis] = spread_x > 0 ? slope_x[axis] / spread_x : 0;
    patch.step_y[axis] = spread_y > 0 ? slope_y[axis] / spread_y : 0;
  }
  for (int64_t i = 0; i < patch.rows; i++)
    for (int64_t j = 0; j < patch.columns; j++)
      for (int64_t axis = 0; axis < 3; axis++)
        rest[i * kPatchSide + j][axis] -=
            mean[axis] + (j - mid_x) * patch.step_x[axis] + (i - mid_y) * patch.step_y[axis];
}

// Direction of the residuals from the plane (the vertical, for terrain): the dominant eigenvector of their second
// moments, by four power iterations. Sets `up`, `terrain`, `irregular` and `height`.
void fit_height(Patch& patch, double deviation_cells, const double rest[kPixels][3], double height[kPixels]) {
  double moment[3][3] = {}, largest = 0;
  for (int64_t i = 0; i < patch.rows; i++)
    for (int64_t j = 0; j < patch.columns; j++) {
      const double* r = rest[i * kPatchSide + j];
      const double square = dot(r, r);
      largest = square <= largest ? largest : square;  // keeps a NaN
      for (int64_t a = 0; a < 3; a++)
        for (int64_t b = 0; b < 3; b++) moment[a][b] += r[a] * r[b];
    }
  patch.terrain = !(largest <= deviation_cells * deviation_cells);
  patch.irregular = false;
  std::memset(patch.up, 0, sizeof patch.up);
  if (!patch.terrain) return;
  int64_t start = 0;
  for (int64_t a = 1; a < 3; a++)
    if (moment[a][a] > moment[start][start]) start = a;
  double up[3] = {moment[start][0], moment[start][1], moment[start][2]};
  for (int64_t iteration = 0; iteration < 4; iteration++) {
    const double length = std::sqrt(dot(up, up));
    for (double& value : up) value /= length;
    const double next[3] = {dot(moment[0], up), dot(moment[1], up), dot(moment[2], up)};
    std::memcpy(up, next, sizeof up);
  }
  const double length = std::sqrt(dot(up, up));
  for (int64_t axis = 0; axis < 3; axis++) patch.up[axis] = up[axis] / length;
  double aside = 0;  // largest squared residual perpendicular to `up`
  for (int64_t i = 0; i < patch.rows; i++)
    for (int64_t j = 0; j < patch.columns; j++) {
      const double* r = rest[i * kPatchSide + j];
      height[i * kPatchSide + j] = dot(r, patch.up);
      const double square = dot(r, r) - height[i * kPatchSide + j] * height[i * kPatchSide + j];
      aside = square <= aside ? aside : square;
    }
  patch.irregular = !(aside <= deviation_cells * deviation_cells);
}

// Centre and mean height of a block, and the largest distances of its pixels from them.
void describe_block(Patch& patch, int64_t block, const double height[kPixels]) {
  double sum = 0;
  int64_t count = 0;
  for (int64_t slot = 16 * block; patch.terrain && slot < 16 * block + 16; slot++)
    if (holds(patch, slot)) sum += height[pixel_row(slot) * kPatchSide + pixel_column(slot)], count++;
  const double level = count ? sum / count : 0;
  const double x = block_column(block) + 1.5 - 0.5 * (patch.columns - 1);
  const double y = block_row(block) + 1.5 - 0.5 * (patch.rows - 1);
  double centre[3];
  for (int64_t axis = 0; axis < 3; axis++)
    centre[axis] = x * patch.step_x[axis] + y * patch.step_y[axis] + level * patch.up[axis];
  patch.along_x[block] = float(x), patch.along_y[block] = float(y), patch.height[block] = float(level);
  patch.square[block] = float(dot(centre, centre));
  patch.dot_x[block] = float(dot(centre, patch.step_x));
  patch.dot_y[block] = float(dot(centre, patch.step_y));
  patch.dot_h[block] = float(dot(centre, patch.up));
  patch.block_reach = std::fmax(patch.block_reach, std::sqrt(patch.square[block]));
  for (int64_t slot = 16 * block; patch.terrain && slot < 16 * block + 16; slot++) {
    if (!holds(patch, slot)) continue;
    const double above = height[pixel_row(slot) * kPatchSide + pixel_column(slot)], rise = above - level;
    patch.rise[slot] = float(rise);
    patch.rise_max = std::fmax(patch.rise_max, float(std::fabs(rise)));
    patch.height_max = std::fmax(patch.height_max, float(std::fabs(above)));
  }
}

// Centres of the sector over a patch, integration.md (4). Blocks with missing pixels are assumed to have no slopes.
void describe_centres(const ApertureJob& job, Patch& patch) {
  const SectorJob& sector = *job.sector;
  const Flown about = flown_past(sector, patch.origin, (patch.block_reach + patch.pixel_reach) / job.cells_per_metre);
  const bool passed = about.first + about.slack <= sector.centre - sector.outer &&
                      about.last - about.slack >= sector.centre + sector.outer;
  if (passed && !patch.irregular) return;
  int64_t count = 0;
  double sum = 0;
  for (int64_t slot = 0; slot < kPixels; slot++) {
    if (!holds(patch, slot)) continue;
    const int64_t row = patch.row + pixel_row(slot), column = patch.column + pixel_column(slot);
    const Flown own = flown_past(sector, job.pixels + 3 * (row * job.columns + column), 0);
    const double centre = centre_of(sector, own);
    patch.moved[slot] = std::isfinite(centre) ? float(centre - sector.centre) : 0;
    sum += patch.moved[slot], count++;
  }
  patch.moved_mean = float(sum / count);
  for (int64_t block = 0; block < kBlocks; block++) {
    int64_t here = 0;
    double level = 0, along_x = 0, along_y = 0;
    for (int64_t slot = 16 * block; slot < 16 * block + 16; slot++) {
      if (!holds(patch, slot)) continue;
      level += patch.moved[slot], here++;
      along_x += (pixel_column(slot) - block_column(block) - 1.5) * patch.moved[slot];
      along_y += (pixel_row(slot) - block_row(block) - 1.5) * patch.moved[slot];
    }
    if (here) patch.moved_b[block] = float(level / here);
    // Squares of -1.5, -0.5, 0.5 and 1.5, four times each, add up to 20.
    if (here == 16) patch.moved_x[block] = float(along_x / 20), patch.moved_y[block] = float(along_y / 20);
    for (int64_t slot = 16 * block; slot < 16 * block + 16; slot++) {
      if (!holds(patch, slot)) continue;
      const double x = double(pixel_column(slot) - block_column(block)) - 1.5;
      const double y = double(pixel_row(slot) - block_row(block)) - 1.5;
      const double rest =
          patch.moved[slot] - patch.moved_b[block] - x * patch.moved_x[block] - y * patch.moved_y[block];
      patch.moved_bend = std::fmax(patch.moved_bend, float(std::fabs(rest)));
      patch.moved_reach = std::fmax(patch.moved_reach, std::fabs(patch.moved[slot] - patch.moved_mean));
    }
  }
}

}  // namespace

void fit(const ApertureJob& job, int64_t row, int64_t column, double deviation_cells, Patch& patch) {
  std::memset(static_cast<void*>(&patch), 0, sizeof patch);
  patch.row = row, patch.column = column;
  patch.rows = job.rows - row < kPatchSide ? job.rows - row : kPatchSide;
  patch.columns = job.columns - column < kPatchSide ? job.columns - column : kPatchSide;
  double rest[kPixels][3], height[kPixels] = {};
  fit_plane(job, patch, rest);
  fit_height(patch, deviation_cells, rest, height);
  patch.xx = float(dot(patch.step_x, patch.step_x));
  patch.xy = float(dot(patch.step_x, patch.step_y));
  patch.yy = float(dot(patch.step_y, patch.step_y));
  patch.xh = float(dot(patch.step_x, patch.up));
  patch.yh = float(dot(patch.step_y, patch.up));
  for (int64_t block = 0; block < kBlocks; block++) {
    patch.present[block] = block_row(block) < patch.rows && block_column(block) < patch.columns;
    if (patch.present[block]) describe_block(patch, block, height);
  }
  // Distance of a block's corner pixel from its centre, plus the largest height, which may add in any direction.
  for (int64_t side = -1; side <= 1; side += 2) {
    double corner[3];
    for (int64_t axis = 0; axis < 3; axis++) corner[axis] = 1.5 * (patch.step_x[axis] + side * patch.step_y[axis]);
    patch.pixel_reach = std::fmax(patch.pixel_reach, float(std::sqrt(dot(corner, corner))));
  }
  patch.pixel_reach += patch.rise_max;
  const float reach = patch.block_reach, inner = patch.pixel_reach;
  patch.fifth = reach * reach * reach * reach * (kFifthOrder * reach + inner);
  patch.third = kThirdOrder * inner * inner * inner;
  patch.shared = kSharedCurvatureError * reach * inner * inner;
  patch.own = kOwnCurvatureError * reach * reach * inner * inner;
  if (job.sector && job.sector->ends) describe_centres(job, patch);
  // A block without pixels receives the geometry of one with pixels, so that it does not affect its group's windows.
  for (int64_t block = 0; block < kBlocks; block++)
    if (!patch.present[block]) {
      const int64_t like = patch.present[block / 4 * 4] ? block / 4 * 4 : 0;
      for (float* array :
           {patch.along_x, patch.along_y, patch.height, patch.square, patch.dot_x, patch.dot_y, patch.dot_h})
        array[block] = array[like];
    }
}

}  // namespace apertura
