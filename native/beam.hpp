// Weight of antennas whose beams rotate from pulse to pulse: gains at eleven nodes of a patch, interpolated by
// polynomials per block, or pixel by pixel if these are not accurate. Errors and equation numbers:
// docs/theory/engine.md, "Antennas".
#pragma once
#include "batch.hpp"
#include "pattern.hpp"
#include "sector.hpp"

namespace {

constexpr int64_t kPlaneNodes = 9;  // 3 x 3 over the plane of a patch, row by row
constexpr int64_t kNodes = 11;      // with heights: also the lowered and the raised centre

// Computation of a pulse's weight over a patch: pixel by pixel, by polynomials of its blocks, or zero.
enum Weighing { kPixelwise, kSmooth, kDark };

// Gains at the nodes of a patch and classification of the patch, for eight pulses.
struct NodeGains {
  alignas(64) float gain[kNodes][kBatch];             // product over the antennas processed so far
  alignas(64) float low[2][kBatch], high[2][kBatch];  // smallest, largest position in this antenna's two cuts
  alignas(64) float ahead[kBatch];                    // largest distance of the patch in front of this antenna
  alignas(64) int32_t dark[kBatch], smooth[kBatch];   // patch without gain; patch inside both cuts
};

// Vectors from antennas to a patch along the antenna axes, in cells: to its origin, and from node to node.
struct BeamFrame {
  alignas(64) float origin[3][kBatch], step_x[3][kBatch], step_y[3][kBatch], up[3][kBatch];
};

inline void turn_to_axes(const BeamJob& beam, const double* antenna, const ApertureJob& job, const Patch& patch,
                         int64_t pulse, BeamFrame& to) {
  const int64_t n = job.padded;
  const float half_x = apertura::half_span(patch.columns), half_y = apertura::half_span(patch.rows);
  for (int64_t axis = 0; axis < 3; axis++) {
    const double *x = beam.axes + 3 * axis * n + pulse, *y = x + n, *z = y + n;
    for (int64_t q = 0; q < kBatch; q++) {
      const double wx = patch.origin[0] - antenna[pulse + q], wy = patch.origin[1] - antenna[n + pulse + q],
                   wz = patch.origin[2] - antenna[2 * n + pulse + q];
      to.origin[axis][q] = float((wx * x[q] + wy * y[q] + wz * z[q]) * job.cells_per_metre);
      to.step_x[axis][q] = half_x * float(patch.step_x[0] * x[q] + patch.step_x[1] * y[q] + patch.step_x[2] * z[q]);
      to.step_y[axis][q] = half_y * float(patch.step_y[0] * x[q] + patch.step_y[1] * y[q] + patch.step_y[2] * z[q]);
      to.up[axis][q] = patch.height_max * float(patch.up[0] * x[q] + patch.up[1] * y[q] + patch.up[2] * z[q]);
    }
  }
}

// Marks pulses whose patch is outside the narrowest cone about the boresight that contains the pattern, without
// computing angles.
inline void mark_outside_cone(const BeamJob& beam, const BeamFrame& to, int32_t* dark) {
  float edge[2];
  for (int64_t cut = 0; cut < 2; cut++) {
    const double first = beam.first_rad[cut], last = last_rad(beam, cut);
    edge[cut] = __builtin_cosf(float(last < -first ? -first : last));
  }
  const float widest = edge[0] < 0 ? edge[0] : edge[0] * (edge[1] < 0 ? 0 : edge[1]);
  const auto length = [](const float (*v)[kBatch], int64_t q) {
    return __builtin_sqrtf(v[0][q] * v[0][q] + v[1][q] * v[1][q] + v[2][q] * v[2][q]);
  };
  for (int64_t q = 0; q < kBatch; q++) {
    // The patch is inside a ball of radius `reach`; its most favourable point is `reach` farther along the boresight.
    const float far = length(to.origin, q), reach = length(to.step_x, q) + length(to.step_y, q) + length(to.up, q);
    dark[q] |= to.origin[0][q] + reach < widest * (widest < 0 ? far + reach : far - reach) - 1e-3f * far;
  }
}

// Multiplies (6) of one antenna into the gains at the nodes, and records the range of its cuts that they span.
inline void sample_nodes(const BeamJob& beam, const Patch& patch, const BeamFrame& to, NodeGains& out) {
  for (int64_t node = 0; node < (patch.terrain ? kNodes : kPlaneNodes); node++) {
    // Node (x, y) of the plane in half widths of the patch, or the lowered (h = -1) or raised (1) centre.
    const bool plane = node < kPlaneNodes;
    const float x = plane ? float(node % 3 - 1) : 0, y = plane ? float(node / 3 - 1) : 0;
    const float h = plane ? 0 : float(2 * (node - kPlaneNodes) - 1);
    alignas(64) float place[2][kBatch];
    for (int64_t q = 0; q < kBatch; q++) {
      float v[3];
      for (int64_t axis = 0; axis < 3; axis++)
        v[axis] = to.origin[axis][q] + x * to.step_x[axis][q] + y * to.step_y[axis][q] + h * to.up[axis][q];
      out.ahead[q] = node && !(v[0] > out.ahead[q]) ? out.ahead[q] : v[0];
      place[0][q] = azimuth_place(beam, v[0], v[1]);
      place[1][q] = elevation_place(beam, v[0], v[1], v[2]);
    }
    for (int64_t cut = 0; cut < 2; cut++)
      for (int64_t q = 0; q < kBatch; q++) {
        const float at = place[cut][q];
        out.gain[node][q] *= look_up(beam, cut, at);
        out.low[cut][q] = node && !(at < out.low[cut][q]) ? out.low[cut][q] : at;  // keeps a NaN at the origin
        out.high[cut][q] = node && !(at > out.high[cut][q]) ? out.high[cut][q] : at;
      }
  }
}

// Marks patches that are entirely inside or outside the pattern.
inline void compare_with_cuts(const BeamJob& beam, const BeamFrame& to, NodeGains& out) {
  const bool forward = beam.first_rad[0] >= -1.5708 && last_rad(beam, 0) <= 1.5708;
  for (int64_t q = 0; q < kBatch; q++) out.dark[q] |= forward && out.ahead[q] + magnitude(to.up[0][q]) < -1e-3f;
  for (int64_t cut = 0; cut < 2; cut++) {
    const float last = float(beam.count[cut] - 1), radian = float(beam.samples_per_rad[cut]);
    for (int64_t q = 0; q < kBatch; q++) {
      // Angles between nodes exceed those at nodes by less than half of their span.
      const float low = out.low[cut][q], high = out.high[cut][q], beyond = 1e-3f + 0.5f * (high - low);
      const bool near = high - low <= radian;  // does not enclose the pole or the cut at ±pi
      out.dark[q] |= near && (high + beyond < 0 || low - beyond > last);
      out.smooth[q] &= near && low - beyond >= 0 && high + beyond <= last;
    }
  }
}

// Biquadratic through the gains `g` of one pulse at the nodes, (7): value and slopes in each block. Returns true if it
// is accurate. d_x and d_y are first differences per half width of the patch, d_xx and d_yy halves of second
// differences, d_xy and d_xyy those of d_x along columns.
inline bool fit_weights(const Patch& patch, const float* g, float peak, int64_t q, Batch& batch) {
  float middle[3], d_x[3], d_xx[3], change = 0, curvature = 0;
  const auto compare = [&](float a, float b, float c) {
    const float first = magnitude(c - a), second = magnitude(a - 2 * b + c);
    change = first <= change ? change : first, curvature = second <= curvature ? curvature : second;
  };
  // Along each row of nodes: centre value, slope and curvature.
  for (int64_t i = 0; i < 3; i++) {
    compare(g[3 * i], g[3 * i + 1], g[3 * i + 2]), compare(g[i], g[3 + i], g[6 + i]);
    middle[i] = g[3 * i + 1], d_x[i] = 0.5f * (g[3 * i + 2] - g[3 * i]);
    d_xx[i] = 0.5f * (g[3 * i] + g[3 * i + 2]) - g[3 * i + 1];
  }
  if (patch.terrain) compare(g[9], g[4], g[10]);
  if (!(change <= apertura::kWeightChange * peak && curvature <= apertura::kWeightCurvature * peak)) return false;
  const float per_x = 1 / apertura::half_span(patch.columns), per_y = 1 / apertura::half_span(patch.rows);
  const float slope_h = patch.terrain ? 0.5f * (g[10] - g[9]) / patch.height_max : 0;
  batch.weight_h[q] = slope_h;
  for (int64_t b = 0; b < kBlocks; b += kLanes) {
    // Parabolas of the three rows at the column of each block: values and slopes along x.
    const Lanes x = load(patch.along_x + b) * per_x, y = load(patch.along_y + b) * per_y;
    Lanes value[3], slope[3];
    for (int64_t i = 0; i < 3; i++)
      value[i] = middle[i] + x * (d_x[i] + x * d_xx[i]), slope[i] = d_x[i] + 2 * x * d_xx[i];
    // Parabola through the three values along y.
    const Lanes d_y = 0.5f * (value[2] - value[0]), d_yy = 0.5f * (value[0] + value[2]) - value[1];
    const Lanes d_xy = 0.5f * (slope[2] - slope[0]), d_xyy = 0.5f * (slope[0] + slope[2]) - slope[1];
    store(batch.weight[q] + b, value[1] + y * (d_y + y * d_yy) + slope_h * load(patch.height + b));
    store(batch.weight_x[q] + b, per_x * (slope[1] + y * (d_xy + y * d_xyy)));
    store(batch.weight_y[q] + b, per_y * (d_y + 2 * y * d_yy));
  }
  return true;
}

// Weights of eight pulses over the blocks of a patch, and the computation of each.
inline void weigh_patch(const ApertureJob& job, const Patch& patch, int64_t pulse, Batch& batch, Weighing* weighing) {
  NodeGains nodes;
  BeamFrame to[2];
  float peak = 1;
  bool lit = false;
  for (int64_t q = 0; q < kBatch; q++) nodes.dark[q] = 0, nodes.smooth[q] = 1;
  for (int64_t leg = 0; leg < 2; leg++)
    if (const BeamJob* beam = job.beam[leg]) {
      turn_to_axes(*beam, leg ? job.receiver : job.transmitter, job, patch, pulse, to[leg]);
      mark_outside_cone(*beam, to[leg], nodes.dark);
    }
  for (int64_t q = 0; q < kBatch; q++) weighing[q] = kDark, lit |= patch.irregular || !nodes.dark[q];
  if (!lit) return;
  for (int64_t node = 0; node < kNodes; node++)
    for (int64_t q = 0; q < kBatch; q++) nodes.gain[node][q] = 1;
  for (int64_t leg = 0; leg < 2; leg++)
    if (const BeamJob* beam = job.beam[leg]) {
      sample_nodes(*beam, patch, to[leg], nodes);
      compare_with_cuts(*beam, to[leg], nodes);
      peak *= float(beam->peak);
    }
  for (int64_t q = 0; q < kBatch; q++) {
    float g[kNodes];
    for (int64_t node = 0; node < kNodes; node++) g[node] = nodes.gain[node][q];
    if (patch.irregular || !nodes.dark[q])
      weighing[q] = nodes.smooth[q] && fit_weights(patch, g, peak, q, batch) ? kSmooth : kPixelwise;
  }
}

// Product of (6) and the sector's weight for one pulse at each pixel of a patch.
inline void weigh_pixels(const ApertureJob& job, const Patch& patch, const Positions& at, int64_t pulse,
                         float* weight) {
  const int64_t n = job.padded;
  for (int64_t slot = 0; slot < kPixels; slot++) weight[slot] = 1;
  if (job.sector) weigh_by_sector(job, patch, at, pulse, weight);
  for (int64_t leg = 0; leg < 2; leg++) {
    const BeamJob* beam = job.beam[leg];
    if (!beam) continue;
    const double *antenna = (leg ? job.receiver : job.transmitter) + pulse, *axes = beam->axes + pulse;
    for (int64_t slot = 0; slot < kPixels; slot++) {
      const double wx = at.x[slot] - antenna[0], wy = at.y[slot] - antenna[n], wz = at.z[slot] - antenna[2 * n];
      float v[3];
      for (int64_t axis = 0; axis < 3; axis++)
        v[axis] = float(wx * axes[3 * axis * n] + wy * axes[(3 * axis + 1) * n] + wz * axes[(3 * axis + 2) * n]);
      weight[slot] *= look_up(*beam, 0, azimuth_place(*beam, v[0], v[1]));
      weight[slot] *= look_up(*beam, 1, elevation_place(*beam, v[0], v[1], v[2]));
    }
  }
}

// Sorts eight pulses by their variant; `places`: their positions in a sector, or null.
template <bool kTerrain>
inline void sort_weighted(const ApertureJob& job, const Patch& patch, int64_t pulse, int64_t pulses,
                          const SectorPlaces* places, Batch& batch) {
  OriginPaths origin;
  Weighing weighing[kBatch];
  weigh_patch(job, patch, pulse, batch, weighing);
  for (int64_t q = 0; places && q < pulses; q++) {
    if (places->zone[q] == kOutside) weighing[q] = kDark;
    if (places->zone[q] == kEdgePixelwise && weighing[q] == kSmooth) weighing[q] = kPixelwise;
  }
  bool lit = false;
  for (int64_t q = 0; q < pulses; q++) lit |= weighing[q] != kDark;
  if (lit) find_origin_paths<kTerrain>(job, patch, pulse, origin);
  for (int64_t variant = 0; variant < kVariants; variant++) batch.count[variant] = 0;
  for (int64_t q = 0; q < pulses; q++) {
    Variant variant = kExactPath;
    if (weighing[q] == kDark)
      variant = kSkipped;
    else if (weighing[q] == kSmooth && origin.holds[q])
      variant = expand_paths<kTerrain, true>(job, patch, origin, pulse, q, batch);
    if (variant == kOwnCurvature) {
      variant = kWeighted;
      if (places && places->zone[q] == kEdge) {
        fit_depth(job, patch, origin, *places, pulse, q, batch);
        variant = kWeightedAtEdge;
      }
    }
    batch.order[variant][batch.count[variant]++] = q;
  }
}

}  // namespace
