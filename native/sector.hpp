// Integration sector: pulses that contribute to all of a patch, to none of it, or at the smooth edge of the sector,
// where the weight depends on the pixel. Equation numbers are those of docs/theory/integration.md.
#pragma once
#include "exact.hpp"

namespace {

// Position of a patch relative to a pulse's sector. At a curved edge, or with both edges in reach, pixels are weighted
// one by one.
enum Zone { kInside, kEdge, kEdgePixelwise, kOutside };

// Components of the vectors from both antennas to a patch's origin along the sector's axes, for eight pulses.
struct SectorPlaces {
  alignas(64) float along[2][kBatch];    // w . a, in cells
  alignas(64) float inverse[2][kBatch];  // 1 / R, per cell
  alignas(64) float place[kBatch];       // s of (1) at the origin, minus the centre
  Zone zone[kBatch];
};

// Values of s for eight pulses at a patch's origin, and the zones that follow from their largest change in the patch.
inline void place_in_sector(const ApertureJob& job, const Patch& patch, int64_t pulse, SectorPlaces& out) {
  const SectorJob& sector = *job.sector;
  const int64_t n = job.padded;
  const float inner = float(sector.inner), outer = float(sector.outer);
  const float reach = patch.block_reach + patch.pixel_reach, inside_block = patch.pixel_reach * patch.pixel_reach;
  alignas(64) float slack[kBatch], bend[kBatch];
  for (int64_t q = 0; q < kBatch; q++) {
    out.place[q] = float(-sector.centre) - patch.moved_mean;
    slack[q] = patch.moved_reach, bend[q] = patch.moved_bend;
  }
  for (int64_t leg = 0; leg < 2; leg++) {
    const double *antenna = (leg ? job.receiver : job.transmitter) + pulse, *axis = sector.axis[leg] + pulse;
    for (int64_t q = 0; q < kBatch; q++) {
      const double wx = patch.origin[0] - antenna[q], wy = patch.origin[1] - antenna[n + q],
                   wz = patch.origin[2] - antenna[2 * n + q];
      const double ax = axis[q], ay = axis[n + q], az = axis[2 * n + q];
      const double scale = job.cells_per_metre, distance = __builtin_sqrt(wx * wx + wy * wy + wz * wz) * scale;
      const double along = (wx * ax + wy * ay + wz * az) * scale;
      const float inverse = float(1 / distance), length = __builtin_sqrtf(float(ax * ax + ay * ay + az * az));
      out.along[leg][q] = float(along), out.inverse[leg][q] = inverse, out.place[q] += float(along / distance);
      // A direction changes by at most asin(reach / R); the second-order expansion at the origin has an error of
      // 3 D d^2 / R^3 inside a block.
      slack[q] += length * (reach * inverse < 1 ? 1.5708f * reach * inverse : 2);
      bend[q] += length * 3 * reach * inside_block * inverse * inverse * inverse;
    }
  }
  const float most = apertura::kSectorBend * (outer - inner);
  for (int64_t q = 0; q < kBatch; q++) {
    const float place = magnitude(out.place[q]);
    Zone zone = place + slack[q] <= inner ? kInside : place - slack[q] >= outer ? kOutside : kEdge;
    const bool both = slack[q] - place >= inner;
    if (zone == kEdge && (both || patch.irregular || !(bend[q] <= most))) zone = kEdgePixelwise;
    out.zone[q] = zone;
  }
}

// Depth inside the sector in widths of its edge, (5): value at the centre of each block, and slopes.
inline void fit_depth(const ApertureJob& job, const Patch& patch, const OriginPaths& origin, const SectorPlaces& places,
                      int64_t pulse, int64_t q, Batch& batch) {
  const SectorJob& sector = *job.sector;
  const int64_t n = job.padded;
  const float side = places.place[q] < 0 ? 1 : -1, per_width = float(1 / (sector.outer - sector.inner));
  alignas(64) float s[kBlocks], s_x[kBlocks], s_y[kBlocks];
  for (int64_t b = 0; b < kBlocks; b++) {
    s[b] = float(-sector.centre) - patch.moved_b[b];
    s_x[b] = -patch.moved_x[b], s_y[b] = -patch.moved_y[b];
  }
  float s_h = 0, s_xx = 0, s_xy = 0, s_yy = 0;
  for (int64_t leg = 0; leg < 2; leg++) {
    const double* axis = sector.axis[leg] + pulse + q;
    const auto along_axis = [&](const double* v) {
      return float(v[0] * axis[0] + v[1] * axis[n] + v[2] * axis[2 * n]);
    };
    const float a_x = along_axis(patch.step_x), a_y = along_axis(patch.step_y), a_h = along_axis(patch.up);
    const Leg& w = origin.leg[leg];
    const float along = places.along[leg][q], inverse = places.inverse[leg][q], range = 1 / inverse;
    const float up = patch.terrain ? w.h[q] : 0;
    for (int64_t b = 0; b < kBlocks; b++) {
      // With d the block's offset from the origin and v = w + d: s = v . a / |v|, with |v| from |w|, w . d and |d|.
      const float x = patch.along_x[b], y = patch.along_y[b], h = patch.height[b];
      const float more = (2 * range * (w.x[q] * x + w.y[q] * y + up * h) + patch.square[b]) * inverse * inverse;
      const float per_range = inverse / __builtin_sqrtf(1 + more);
      const float cosine = (along + x * a_x + y * a_y + h * a_h) * per_range;
      s[b] += cosine;
      s_x[b] += (a_x - cosine * (w.x[q] * range + patch.dot_x[b]) * per_range) * per_range;
      s_y[b] += (a_y - cosine * (w.y[q] * range + patch.dot_y[b]) * per_range) * per_range;
    }
    s_h += (a_h - along * inverse * up) * inverse;
    const float squared = inverse * inverse, cosine = along * inverse, x = w.x[q], y = w.y[q];
    s_xx += squared * (cosine * (3 * x * x - patch.xx) - 2 * a_x * x) * 0.5f;
    s_xy += squared * (cosine * (3 * x * y - patch.xy) - a_x * y - a_y * x);
    s_yy += squared * (cosine * (3 * y * y - patch.yy) - 2 * a_y * y) * 0.5f;
  }
  for (int64_t b = 0; b < kBlocks; b++) {
    batch.depth[q][b] = (float(sector.outer) + side * s[b]) * per_width;
    batch.depth_x[q][b] = side * s_x[b] * per_width;
    batch.depth_y[q][b] = side * s_y[b] * per_width;
  }
  batch.depth_h[q] = side * s_h * per_width;
  batch.depth_xx[q] = side * s_xx * per_width, batch.depth_xy[q] = side * s_xy * per_width;
  batch.depth_yy[q] = side * s_yy * per_width;
}

// Multiplies `weight` by (3), the sector's weight of one pulse at each pixel of a patch.
inline void weigh_by_sector(const ApertureJob& job, const Patch& patch, const Positions& at, int64_t pulse,
                            float* weight) {
  const SectorJob& sector = *job.sector;
  const int64_t n = job.padded;
  const double per_width = 1 / (sector.outer - sector.inner);
  for (int64_t slot = 0; slot < kPixels; slot++) {
    double place = -sector.centre - patch.moved[slot];
    for (int64_t leg = 0; leg < 2; leg++) {
      const double *antenna = (leg ? job.receiver : job.transmitter) + pulse, *axis = sector.axis[leg] + pulse;
      const double wx = at.x[slot] - antenna[0], wy = at.y[slot] - antenna[n], wz = at.z[slot] - antenna[2 * n];
      place += (wx * axis[0] + wy * axis[n] + wz * axis[2 * n]) / __builtin_sqrt(wx * wx + wy * wy + wz * wz);
    }
    const double depth = (sector.outer - (place < 0 ? -place : place)) * per_width;
    const float held = depth > 0 ? depth < 1 ? float(depth) : 1.0f : 0.0f;
    weight[slot] *= held * held * (3 - 2 * held);
  }
}

// Sorts eight pulses by their variant if not all of them are inside the sector.
template <bool kTerrain>
inline void sort_at_edge(const ApertureJob& job, const Patch& patch, int64_t pulse, int64_t pulses,
                         const SectorPlaces& places, Batch& batch) {
  OriginPaths origin;
  find_origin_paths<kTerrain>(job, patch, pulse, origin);
  for (int64_t variant = 0; variant < kVariants; variant++) batch.count[variant] = 0;
  for (int64_t q = 0; q < pulses; q++) {
    Variant variant = kExactPath;
    if (places.zone[q] == kOutside)
      variant = kSkipped;
    else if (places.zone[q] == kInside && origin.holds[q] == 2)
      variant = expand_paths<kTerrain, false>(job, patch, origin, pulse, q, batch);
    else if (places.zone[q] != kEdgePixelwise && origin.holds[q])
      variant = expand_paths<kTerrain, true>(job, patch, origin, pulse, q, batch);
    if (places.zone[q] == kEdge && variant == kOwnCurvature) {
      fit_depth(job, patch, origin, places, pulse, q, batch);
      variant = kAtEdge;
    }
    batch.order[variant][batch.count[variant]++] = q;
  }
}

}  // namespace
