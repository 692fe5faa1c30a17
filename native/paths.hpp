// Total path of a patch for eight pulses at once: float64 at its origin, series in float32 from there.
// docs/theory/engine.md derives the series. Plain loops: the compiler vectorises them for each instruction set.
#pragma once
#include "patch.hpp"

namespace {

using apertura::kBlocks;
using apertura::kPixels;
using apertura::kSide;
using apertura::Patch;

constexpr int kBatch = 8;  // pulses

// From one antenna to the origin of a patch.
struct Leg {
  alignas(64) float x[kBatch], y[kBatch], h[kBatch];  // direction cosines with step_x, step_y, up: cells per pixel
  alignas(64) float inverse[kBatch];                  // 1 / distance, per cell
};

struct Aim {
  Leg leg[2];
  alignas(64) double path[kBatch];     // total path, in cells of the table
  alignas(64) float shared[kBatch];    // largest error in cells if the patch shares one curvature
  alignas(64) float own[kBatch];       // and if each block has its own
};

inline void aim_leg(const double* antenna, const ApertureJob& job, const Patch& patch, Leg& leg, Aim& aim) {
  const double scale = job.cells_per_metre;
  const double *ax = antenna, *ay = antenna + job.padded, *az = antenna + 2 * job.padded;
  const double reach = patch.reach, inner = patch.inner;
  const double fifth = reach * reach * reach * reach * (0.14 * reach + inner);
  const double third = 0.19 * inner * inner * inner, mixed = 0.58 * reach * inner * inner;
  const double fourth = 0.75 * reach * reach * inner * inner;
  for (int q = 0; q < kBatch; q++) {
    const double wx = (patch.origin[0] - ax[q]) * scale, wy = (patch.origin[1] - ay[q]) * scale,
                 wz = (patch.origin[2] - az[q]) * scale;
    const double distance = __builtin_sqrt(wx * wx + wy * wy + wz * wz), inverse = 1.0 / distance;
    leg.x[q] = float((wx * patch.step_x[0] + wy * patch.step_x[1] + wz * patch.step_x[2]) * inverse);
    leg.y[q] = float((wx * patch.step_y[0] + wy * patch.step_y[1] + wz * patch.step_y[2]) * inverse);
    leg.h[q] = float((wx * patch.up[0] + wy * patch.up[1] + wz * patch.up[2]) * inverse);
    leg.inverse[q] = float(inverse);
    aim.path[q] += distance;
    const double squared = inverse * inverse, base = squared * (third + squared * fifth);
    aim.shared[q] += float(base + squared * mixed);
    aim.own[q] += float(base + squared * inverse * fourth * 0.1);
  }
}

inline void aim_at(const ApertureJob& job, const Patch& patch, int64_t pulse, Aim& aim) {
  for (int q = 0; q < kBatch; q++) {
    aim.path[q] = -job.first_path[pulse + q] * job.cells_per_metre;
    aim.shared[q] = aim.own[q] = 0;
  }
  aim_leg(job.transmitter + pulse, job, patch, aim.leg[0], aim);
  aim_leg(job.receiver + pulse, job, patch, aim.leg[1], aim);
}

// What the pixel loop needs of each block: path and its derivatives at the centre, both legs added.
struct Slopes {
  alignas(64) float path[kBlocks];
  alignas(64) float x[kBlocks], y[kBlocks], h[kBlocks];
  alignas(64) float xx[kBlocks], xy[kBlocks], yy[kBlocks], xh[kBlocks], yh[kBlocks], hh[kBlocks];
};

// Path relative to the origin's and its gradient: Legendre series of |w + d| to fourth and third order.
template <bool kTerrain>
inline void add_leg(const Patch& p, float cx, float cy, float ch, float inverse, Slopes& out) {
  for (int b = 0; b < kBlocks; b++) {
    float alpha = cx * p.along_x[b] + cy * p.along_y[b];
    if constexpr (kTerrain) alpha += ch * p.height[b];
    const float e = alpha * inverse, kappa = p.square[b] * inverse - alpha * e, k = kappa * inverse;
    const float turn = 1.0f + e * (e - 1.0f);
    out.path[b] += alpha + 0.5f * kappa * (turn - 0.25f * k);
    const float nearer = turn - 0.5f * k + e * (1.5f * k - e * e);  // distance of the origin over that of the block
    out.x[b] += (cx + p.dot_x[b] * inverse) * nearer;
    out.y[b] += (cy + p.dot_y[b] * inverse) * nearer;
    if constexpr (kTerrain) out.h[b] += (ch + p.dot_h[b] * inverse) * nearer;
  }
}

// Second derivatives of each block on its own; 1/R of the block to first order is enough here.
template <bool kTerrain>
inline void add_curvature(const Patch& p, float cx, float cy, float ch, float inverse, Slopes& out) {
  for (int b = 0; b < kBlocks; b++) {
    float alpha = cx * p.along_x[b] + cy * p.along_y[b];
    if constexpr (kTerrain) alpha += ch * p.height[b];
    const float e = alpha * inverse, k = p.square[b] * inverse * inverse - e * e;
    const float nearer = 1.0f + e * (e - 1.0f) - 0.5f * k, half = 0.5f * inverse * nearer;
    const float x = (cx + p.dot_x[b] * inverse) * nearer, y = (cy + p.dot_y[b] * inverse) * nearer;
    out.xx[b] += (p.xx - x * x) * half;
    out.xy[b] += (p.xy - x * y) * 2 * half;
    out.yy[b] += (p.yy - y * y) * half;
    if constexpr (kTerrain) {
      const float h = (ch + p.dot_h[b] * inverse) * nearer;
      out.xh[b] += (p.xh - x * h) * 2 * half;
      out.yh[b] += (p.yh - y * h) * 2 * half;
      out.hh[b] += (1 - h * h) * half;
    }
  }
}

// Second derivatives at the origin of the patch, for all blocks.
struct Curvature {
  float xx, xy, yy, xh, yh, hh;
};

inline Curvature shared_curvature(const Patch& p, const Aim& aim, int q) {
  Curvature sum{};
  for (const Leg& leg : aim.leg) {
    const float half = 0.5f * leg.inverse[q], x = leg.x[q], y = leg.y[q], h = leg.h[q];
    sum.xx += (p.xx - x * x) * half;
    sum.xy += (p.xy - x * y) * 2 * half;
    sum.yy += (p.yy - y * y) * half;
    sum.xh += (p.xh - x * h) * 2 * half;
    sum.yh += (p.yh - y * h) * 2 * half;
    sum.hh += (1 - h * h) * half;
  }
  return sum;
}

}  // namespace
