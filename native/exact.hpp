// The slow way that always holds: the path of each pixel in float64, the table cell by cell.
#pragma once
#include "batch.hpp"

namespace {

// Positions of a patch's pixels, block by block; lanes without a pixel repeat the first.
struct Positions {
  alignas(64) double x[kPixels], y[kPixels], z[kPixels];
};

inline void gather(const ApertureJob& job, const Patch& patch, Positions& out) {
  for (int slot = 0; slot < kPixels; slot++) {
    const int i = apertura::top(slot / 16) + slot % 16 / 4, j = apertura::left(slot / 16) + slot % 4;
    const bool present = i < patch.rows && j < patch.columns;
    const int64_t row = patch.row + (present ? i : 0), column = patch.column + (present ? j : 0);
    const double* pixel = job.pixels + 3 * (row * job.columns + column);
    out.x[slot] = pixel[0], out.y[slot] = pixel[1], out.z[slot] = pixel[2];
  }
}

inline void path_of(const ApertureJob& job, const Positions& at, int64_t pulse, double* cell) {
  const double *tx = job.transmitter + pulse, *rx = job.receiver + pulse;
  const int64_t n = job.padded;
  for (int slot = 0; slot < kPixels; slot++) {
    const double ax = at.x[slot] - tx[0], ay = at.y[slot] - tx[n], az = at.z[slot] - tx[2 * n];
    const double bx = at.x[slot] - rx[0], by = at.y[slot] - rx[n], bz = at.z[slot] - rx[2 * n];
    cell[slot] = (__builtin_sqrt(ax * ax + ay * ay + az * az) + __builtin_sqrt(bx * bx + by * by + bz * bz) -
                  job.first_path[pulse]) * job.cells_per_metre;
  }
}

// `weight`: of each pixel, or null for one.
template <class Phase, int kDegree>
inline void add_exact(const ApertureJob& job, const Patch& patch, const Positions& at, int64_t pulse,
                      const float* weight, float* sum) {
  const Phase phase(job.phase);
  const float* row = job.cells + pulse * 2 * (kDegree + 1) * job.width;
  alignas(64) double cell[kPixels];
  path_of(job, at, pulse, cell);
  for (int b = 0; b < kBlocks; b++)
    for (int slot = b * 16; patch.present[b] && slot < b * 16 + 16; slot += kLanes) {
      alignas(64) float taken[2 * (kDegree + 1)][kLanes], rest[kLanes];
      for (int lane = 0; lane < kLanes; lane++) {
        const double middle = __builtin_floor(cell[slot + lane] + 0.5);
        const bool inside = middle >= 0 && middle < double(job.width);
        rest[lane] = inside ? float(cell[slot + lane] - middle) : 0;
        for (int k = 0; k < 2 * (kDegree + 1); k++)
          taken[k][lane] = inside ? row[k * job.width + int64_t(middle)] : 0;
      }
      const Lanes u = load(rest);
      Lanes vr = load(taken[2]), vi = load(taken[3]), cosine, sine;
      if constexpr (kDegree == 2) vr += u * load(taken[4]), vi += u * load(taken[5]);
      vr = load(taken[0]) + u * vr, vi = load(taken[1]) + u * vi;
      phase(u, cosine, sine);
      if (weight) vr *= load(weight + slot), vi *= load(weight + slot);
      store(sum + slot, load(sum + slot) + vr * cosine - vi * sine);
      store(sum + kPixels + slot, load(sum + kPixels + slot) + vr * sine + vi * cosine);
    }
}

}  // namespace
