// Total path of a patch for eight pulses at once: float64 at its origin, series in float32 from there.
// docs/theory/engine.md derives the series. Plain loops: the compiler vectorises them for each instruction set.
#pragma once
#include "lanes.hpp"
#include "patch.hpp"

namespace {

using apertura::kBlocks;
using apertura::kPixels;
using apertura::kSide;
using apertura::Patch;

constexpr int kBatch = 8;  // pulses

inline float magnitude(float value) { return __builtin_fabsf(value); }

// From one antenna to the origin of a patch.
struct Leg {
  alignas(64) float x[kBatch], y[kBatch], h[kBatch];  // direction cosines with step_x, step_y, up: cells per pixel
  alignas(64) float inverse[kBatch];                  // 1 / distance, per cell
};

// Both legs to the origin of a patch: total path, and its second derivatives, by which all blocks may bend alike.
struct Aim {
  Leg leg[2];
  alignas(64) double path[kBatch];                    // in cells of the table
  alignas(64) double start[kBatch];                   // its whole part
  alignas(64) float rest[kBatch];                     // and what is left
  alignas(64) float xx[kBatch], xy[kBatch], yy[kBatch], xh[kBatch], yh[kBatch], hh[kBatch];
  alignas(64) float margin[kBatch];                   // bound of the curvature inside a block
  alignas(64) float first[kBatch], last[kBatch];      // of the table's windows, from `start`
  alignas(64) float shared[kBatch];                   // largest error in cells if the patch shares one curvature
  alignas(64) float own[kBatch];                      // and if each block has its own
  alignas(64) int32_t shallow[kBatch];                // heights inside a block need no curvature
  alignas(64) int32_t holds[kBatch];                  // 2: shared curvature will do, 1: own curvature, 0: neither
};

template <bool kTerrain>
inline void aim_leg(const double* antenna, const ApertureJob& job, const Patch& patch, Leg& leg, Aim& aim) {
  const double scale = job.cells_per_metre;
  const double *ax = antenna, *ay = antenna + job.padded, *az = antenna + 2 * job.padded;
  const Patch& p = patch;
  for (int q = 0; q < kBatch; q++) {
    const double wx = (p.origin[0] - ax[q]) * scale, wy = (p.origin[1] - ay[q]) * scale,
                 wz = (p.origin[2] - az[q]) * scale;
    const double distance = __builtin_sqrt(wx * wx + wy * wy + wz * wz), inverse = 1.0 / distance;
    leg.x[q] = float((wx * p.step_x[0] + wy * p.step_x[1] + wz * p.step_x[2]) * inverse);
    leg.y[q] = float((wx * p.step_y[0] + wy * p.step_y[1] + wz * p.step_y[2]) * inverse);
    if constexpr (kTerrain) leg.h[q] = float((wx * p.up[0] + wy * p.up[1] + wz * p.up[2]) * inverse);
    leg.inverse[q] = float(inverse);
    aim.path[q] += distance;
  }
  const float reach = p.reach, inner = p.inner;
  const float fifth = reach * reach * reach * reach * (0.14f * reach + inner);
  const float third = 0.19f * inner * inner * inner, mixed = 0.58f * reach * inner * inner;
  const float fourth = 0.75f * reach * reach * inner * inner;
  for (int q = 0; q < kBatch; q++) {
    const float inverse = leg.inverse[q], half = 0.5f * inverse, x = leg.x[q], y = leg.y[q], squared = inverse * inverse;
    aim.xx[q] += (p.xx - x * x) * half;
    aim.xy[q] += (p.xy - x * y) * inverse;
    aim.yy[q] += (p.yy - y * y) * half;
    if constexpr (kTerrain) {
      const float h = leg.h[q];
      aim.xh[q] += (p.xh - x * h) * inverse;
      aim.yh[q] += (p.yh - y * h) * inverse;
      aim.hh[q] += (1 - h * h) * half;
    }
    const float base = squared * (third + squared * fifth);
    aim.shared[q] += base + squared * mixed;
    aim.own[q] += base + squared * inverse * fourth * 0.1f;
  }
}

template <bool kTerrain>
inline void aim_at(const ApertureJob& job, const Patch& patch, int64_t pulse, Aim& aim) {
  for (int q = 0; q < kBatch; q++) {
    aim.path[q] = -job.first_path[pulse + q] * job.cells_per_metre;
    aim.xx[q] = aim.xy[q] = aim.yy[q] = aim.xh[q] = aim.yh[q] = aim.hh[q] = aim.shared[q] = aim.own[q] = 0;
  }
  aim_leg<kTerrain>(job.transmitter + pulse, job, patch, aim.leg[0], aim);
  aim_leg<kTerrain>(job.receiver + pulse, job, patch, aim.leg[1], aim);
  const double last = double(job.width) - kWindow;
  const float tolerance = patch.crooked ? -1.0f : float(job.tolerance_rad / job.radians_per_cell);
  for (int q = 0; q < kBatch; q++) {
    aim.start[q] = __builtin_floor(aim.path[q]);
    aim.rest[q] = float(aim.path[q] - aim.start[q]);
    aim.first[q] = float(-aim.start[q]);
    aim.last[q] = float(last - aim.start[q]);
    aim.holds[q] = (int(aim.shared[q] <= tolerance) + int(aim.own[q] <= tolerance)) *
                   int(magnitude(aim.first[q]) < 1e7f);
    // Curvature inside a block is small beside its slope: twice the value at the origin bounds it where fast forms hold.
    aim.margin[q] = 1e-3f + 4.5f * (magnitude(aim.xx[q]) + magnitude(aim.xy[q]) + magnitude(aim.yy[q]));
    if constexpr (kTerrain) {
      const float curved = patch.roughest * (1.5f * (magnitude(aim.xh[q]) + magnitude(aim.yh[q])) +
                                             patch.roughest * aim.hh[q]);
      aim.margin[q] += 2 * curved;
      aim.shallow[q] = aim.shared[q] + curved <= tolerance;
    }
  }
}

// Path and derivatives at the centres of a few blocks.
struct Slope {
  Lanes path{}, x{}, y{}, h{}, xx{}, xy{}, yy{}, xh{}, yh{}, hh{};
};

// Adds one leg for the blocks from `b`: Legendre series of |w + d|, path to fourth order, gradient to third.
template <bool kTerrain, bool kOwnCurvature>
inline void add_leg(const Patch& p, const Leg& leg, int q, int b, Slope& out) {
  const float inverse = leg.inverse[q];
  Lanes alpha = leg.x[q] * load(p.along_x + b) + leg.y[q] * load(p.along_y + b);
  if constexpr (kTerrain) alpha += leg.h[q] * load(p.height + b);
  const Lanes e = alpha * inverse, kappa = load(p.square + b) * inverse - alpha * e, k = kappa * inverse;
  const Lanes turn = 1.0f + e * (e - 1.0f);
  out.path += alpha + 0.5f * kappa * (turn - 0.25f * k);
  const Lanes nearer = turn - 0.5f * k + e * (1.5f * k - e * e);  // distance of the origin over that of the block
  const Lanes x = (load(p.dot_x + b) * inverse + leg.x[q]) * nearer;
  const Lanes y = (load(p.dot_y + b) * inverse + leg.y[q]) * nearer;
  out.x += x, out.y += y;
  Lanes h{};
  if constexpr (kTerrain) h = (load(p.dot_h + b) * inverse + leg.h[q]) * nearer, out.h += h;
  if constexpr (!kOwnCurvature) return;
  const Lanes half = 0.5f * inverse * nearer;
  out.xx += (p.xx - x * x) * half, out.xy += (p.xy - x * y) * 2 * half, out.yy += (p.yy - y * y) * half;
  if constexpr (!kTerrain) return;
  out.xh += (p.xh - x * h) * 2 * half, out.yh += (p.yh - y * h) * 2 * half, out.hh += (1 - h * h) * half;
}

}  // namespace
