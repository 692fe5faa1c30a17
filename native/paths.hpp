// Total paths to a patch for eight pulses at once: in float64 to its origin, series in float32 about it.
// docs/theory/engine.md, "Paths", derives the series; numbers in brackets are its equations. The loops are plain code
// that the compiler vectorises for each instruction set.
#pragma once
#include "lanes.hpp"
#include "patch.hpp"

namespace {

using apertura::kBatch;
using apertura::kBlocks;
using apertura::kPixels;
using apertura::Patch;

// Path from one antenna to the origin of a patch: w = origin - antenna, R = |w|, in cells.
struct Leg {
  alignas(64) float x[kBatch], y[kBatch], h[kBatch];  // w . step_x / R, w . step_y / R, w . up / R: derivatives of R
  alignas(64) float inverse[kBatch];                  // 1 / R
};

// Paths of both antennas to the origin of a patch, for eight pulses: total path, its second-order coefficients (of x^2,
// xy, y^2, xh, yh and h^2, so that xx is half of the second derivative and xy all of it), and the valid series.
struct OriginPaths {
  Leg leg[2];
  alignas(64) double path[kBatch];     // in cells of the table
  alignas(64) double whole[kBatch];    // integer part of `path`
  alignas(64) float fraction[kBatch];  // fractional part of `path`
  alignas(64) float xx[kBatch], xy[kBatch], yy[kBatch], xh[kBatch], yh[kBatch], hh[kBatch];
  alignas(64) float curvature_bound[kBatch];                    // bound of the second-order terms inside a block
  alignas(64) float first_window[kBatch], last_window[kBatch];  // limits of a window's first cell, relative to `whole`
  alignas(64) float shared_error[kBatch];                       // error bound with a common curvature, cells
  alignas(64) float own_error[kBatch];                          // error bound with a curvature per block, cells
  alignas(64) int32_t linear_heights[kBatch];                   // 1: heights inside a block need no second-order terms
  alignas(64) int32_t holds[kBatch];                            // 2: shared curvature, 1: own curvature, 0: neither
};

// Adds one antenna to the path and second-order coefficients at the origin, and to the errors of the series about it.
// `leg` is one of `out.leg`, which is not accessed through `out` here.
template <bool kTerrain>
inline void add_origin_leg(const double* antenna, const ApertureJob& job, const Patch& patch, Leg& __restrict leg,
                           OriginPaths& __restrict out) {
  const double scale = job.cells_per_metre;
  const double *ax = antenna, *ay = antenna + job.padded, *az = antenna + 2 * job.padded;
  const Patch& p = patch;
  for (int64_t q = 0; q < kBatch; q++) {
    // w in float64, because coordinates may be geocentric. R adds to the path.
    const double wx = (p.origin[0] - ax[q]) * scale, wy = (p.origin[1] - ay[q]) * scale,
                 wz = (p.origin[2] - az[q]) * scale;
    const double distance = __builtin_sqrt(wx * wx + wy * wy + wz * wz), inverse = 1.0 / distance;
    // Derivatives of R along rows, columns and height: w . q / R, (5) at d = 0. Float32 suffices from here on.
    leg.x[q] = float((wx * p.step_x[0] + wy * p.step_x[1] + wz * p.step_x[2]) * inverse);
    leg.y[q] = float((wx * p.step_y[0] + wy * p.step_y[1] + wz * p.step_y[2]) * inverse);
    if constexpr (kTerrain) leg.h[q] = float((wx * p.up[0] + wy * p.up[1] + wz * p.up[2]) * inverse);
    leg.inverse[q] = float(inverse);
    out.path[q] += distance;
  }
  const float fifth = p.fifth, third = p.third, shared = p.shared, own = p.own;
  for (int64_t q = 0; q < kBatch; q++) {
    const float inverse = leg.inverse[q], half = 0.5f * inverse, x = leg.x[q], y = leg.y[q];
    const float squared = inverse * inverse;
    // (5a) at the origin: the shared curvature.
    out.xx[q] += (p.xx - x * x) * half;
    out.xy[q] += (p.xy - x * y) * inverse;
    out.yy[q] += (p.yy - y * y) * half;
    if constexpr (kTerrain) {
      const float h = leg.h[q];
      out.xh[q] += (p.xh - x * h) * inverse;
      out.yh[q] += (p.yh - y * h) * inverse;
      out.hh[q] += (1 - h * h) * half;
    }
    const float base = squared * (third + squared * fifth);
    out.shared_error[q] += base + squared * shared;
    out.own_error[q] += base + squared * inverse * own;
  }
}

// Paths of eight pulses to the origin of a patch, counted from the first cell of their tables.
template <bool kTerrain>
inline void find_origin_paths(const ApertureJob& job, const Patch& patch, int64_t pulse, OriginPaths& out) {
  for (int64_t q = 0; q < kBatch; q++) {
    out.path[q] = -job.first_path[pulse + q] * job.cells_per_metre;
    out.xx[q] = out.xy[q] = out.yy[q] = out.xh[q] = out.yh[q] = out.hh[q] = out.shared_error[q] = out.own_error[q] = 0;
  }
  add_origin_leg<kTerrain>(job.transmitter + pulse, job, patch, out.leg[0], out);
  add_origin_leg<kTerrain>(job.receiver + pulse, job, patch, out.leg[1], out);
  const double last = double(job.width) - kWindow;
  const float tolerance = patch.irregular ? -1.0f : float(job.tolerance_rad / job.radians_per_cell);
  for (int64_t q = 0; q < kBatch; q++) {
    // Integer cells are counted in float64; the fraction is small enough for float32.
    out.whole[q] = __builtin_floor(out.path[q]);
    out.fraction[q] = float(out.path[q] - out.whole[q]);
    out.first_window[q] = float(-out.whole[q]);
    out.last_window[q] = float(last - out.whole[q]);
    // Series within the tolerance; beyond 1e7 cells, float32 no longer resolves single cells.
    out.holds[q] = (int32_t(out.shared_error[q] <= tolerance) + int32_t(out.own_error[q] <= tolerance)) *
                   int32_t(magnitude(out.first_window[q]) < 1e7f);
    // Curvature inside a block is small compared with its slope: twice the value at the origin bounds it.
    out.curvature_bound[q] =
        1e-3f + apertura::kCurvatureSpan * (magnitude(out.xx[q]) + magnitude(out.xy[q]) + magnitude(out.yy[q]));
    if constexpr (kTerrain) {
      const float of_heights =
          patch.rise_max * (1.5f * (magnitude(out.xh[q]) + magnitude(out.yh[q])) + patch.rise_max * out.hh[q]);
      out.curvature_bound[q] += 2 * of_heights;
      out.linear_heights[q] = out.shared_error[q] + of_heights <= tolerance;
    }
  }
}

// Path and derivatives at the centres of blocks, one block per lane; second-order coefficients as in OriginPaths.
struct BlockPaths {
  Lanes path{}, x{}, y{}, h{}, xx{}, xy{}, yy{}, xh{}, yh{}, hh{};
};

// Adds one antenna for the blocks from `b` on: Legendre series of |w + d|, path to fourth order, gradient to third.
template <bool kTerrain, bool kCurvature>
inline void add_block_leg(const Patch& p, const Leg& leg, int64_t q, int64_t b, BlockPaths& out) {
  const float inverse = leg.inverse[q];
  // alpha = d . w / R, the component of the block's offset d along the line of sight.
  Lanes alpha = leg.x[q] * load(p.along_x + b) + leg.y[q] * load(p.along_y + b);
  if constexpr (kTerrain) alpha += leg.h[q] * load(p.height + b);
  // e = alpha / R and kappa = (|d|^2 - alpha^2) / R^2: components along and across the line of sight, relative to R.
  const Lanes e = alpha * inverse, kappa_range = load(p.square + b) * inverse - alpha * e;
  const Lanes kappa = kappa_range * inverse;
  // (3): |w + d| - R = alpha + kappa R (1 - e + e^2 - kappa / 4) / 2.
  const Lanes along = 1.0f + e * (e - 1.0f);
  out.path += alpha + 0.5f * kappa_range * (along - 0.25f * kappa);
  // (4): R / |w + d| = 1 - e + e^2 - kappa / 2 + e (3 kappa / 2 - e^2).
  const Lanes ratio = along - 0.5f * kappa + e * (1.5f * kappa - e * e);
  // (5): the derivatives along rows, columns and height at the block's centre.
  const Lanes x = (load(p.dot_x + b) * inverse + leg.x[q]) * ratio;
  const Lanes y = (load(p.dot_y + b) * inverse + leg.y[q]) * ratio;
  out.x += x, out.y += y;
  Lanes h{};
  if constexpr (kTerrain) h = (load(p.dot_h + b) * inverse + leg.h[q]) * ratio, out.h += h;
  if constexpr (!kCurvature) return;
  // (5a): the second-order coefficients at the block's centre, with 1 / |w + d| = ratio / R.
  const Lanes half = 0.5f * inverse * ratio;
  out.xx += (p.xx - x * x) * half, out.xy += (p.xy - x * y) * 2 * half, out.yy += (p.yy - y * y) * half;
  if constexpr (!kTerrain) return;
  out.xh += (p.xh - x * h) * 2 * half, out.yh += (p.yh - y * h) * 2 * half, out.hh += (1 - h * h) * half;
}

}  // namespace
