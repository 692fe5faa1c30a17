// Slow variant that is always valid: the path of each pixel in float64, and scalar look-ups in the table.
#pragma once
#include "batch.hpp"

namespace {

// Positions of a patch's pixels, block by block; lanes without a pixel repeat the first pixel.
struct Positions {
  alignas(64) double x[kPixels], y[kPixels], z[kPixels];
};

inline void gather(const ApertureJob& job, const Patch& patch, Positions& out) {
  for (int64_t slot = 0; slot < kPixels; slot++) {
    const bool present = apertura::holds(patch, slot);
    const int64_t row = patch.row + (present ? apertura::pixel_row(slot) : 0);
    const int64_t column = patch.column + (present ? apertura::pixel_column(slot) : 0);
    const double* pixel = job.pixels + 3 * (row * job.columns + column);
    out.x[slot] = pixel[0], out.y[slot] = pixel[1], out.z[slot] = pixel[2];
  }
}

// Path R of (1) to each pixel, in cells of the pulse's table.
inline void exact_paths(const ApertureJob& job, const Positions& at, int64_t pulse, double* path) {
  const double *tx = job.transmitter + pulse, *rx = job.receiver + pulse;
  const int64_t n = job.padded;
  for (int64_t slot = 0; slot < kPixels; slot++) {
    const double ax = at.x[slot] - tx[0], ay = at.y[slot] - tx[n], az = at.z[slot] - tx[2 * n];
    const double bx = at.x[slot] - rx[0], by = at.y[slot] - rx[n], bz = at.z[slot] - rx[2 * n];
    const double legs = __builtin_sqrt(ax * ax + ay * ay + az * az) + __builtin_sqrt(bx * bx + by * by + bz * bz);
    path[slot] = (legs - job.first_path[pulse]) * job.cells_per_metre;
  }
}

// Adds one pulse to all pixels. `weight`: weight of each pixel, or null for weight 1.
template <class Phase, int64_t kDegree>
inline void add_exact(const ApertureJob& job, const Patch& patch, const Positions& at, int64_t pulse,
                      const float* weight, float* sum) {
  const Phase phase(job.phase_coefficients);
  const float* row = job.cells + pulse * 2 * (kDegree + 1) * job.width;
  alignas(64) double path[kPixels];
  exact_paths(job, at, pulse, path);
  for (int64_t b = 0; b < kBlocks; b++)
    for (int64_t slot = b * 16; patch.present[b] && slot < b * 16 + 16; slot += kLanes) {
      // Cell nearest to each pixel's path, lane by lane; zeros beyond the table.
      alignas(64) float coefficient[2 * (kDegree + 1)][kLanes], place[kLanes];
      for (int64_t lane = 0; lane < kLanes; lane++) {
        const double middle = __builtin_floor(path[slot + lane] + 0.5);
        const bool inside = middle >= 0 && middle < double(job.width);
        const float* cell = row + (inside ? int64_t(middle) : 0);
        place[lane] = inside ? float(path[slot + lane] - middle) : 0;
        for (int64_t k = 0; k < 2 * (kDegree + 1); k++) coefficient[k][lane] = inside ? cell[k * job.width] : 0;
      }
      // (2) as in the pixel loop of batch.hpp.
      const Lanes u = load(place);
      Lanes vr = load(coefficient[2]), vi = load(coefficient[3]), cosine, sine;
      if constexpr (kDegree == 2) vr += u * load(coefficient[4]), vi += u * load(coefficient[5]);
      vr = load(coefficient[0]) + u * vr, vi = load(coefficient[1]) + u * vi;
      phase(u, cosine, sine);
      if (weight) vr *= load(weight + slot), vi *= load(weight + slot);
      store(sum + slot, load(sum + slot) + vr * cosine - vi * sine);
      store(sum + kPixels + slot, load(sum + kPixels + slot) + vr * sine + vi * cosine);
    }
}

}  // namespace
