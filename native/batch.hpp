// Eight pulses over one patch: choice of the path variant of each pulse, and the pixel loop of the fast variants.
// Equation numbers in brackets are those of docs/theory/engine.md.
#pragma once
#include "lanes.hpp"
#include "paths.hpp"
#include "phase.hpp"

namespace {

// Variant of the path computation for one pulse over a patch, in order of increasing cost. Curvature is the
// second-order part of the path inside a block, (5a). Windows are the 16 cells of the table that a look-up can reach:
// narrow ones serve a group of four blocks with 16 lanes, one block (8 cells) with 8 lanes, and are not used with 4;
// wide ones serve one block.
enum Variant {
  kSharedCurvature,  // narrow window, all blocks have the curvature of the origin
  kLinearHeights,    // shared curvature, heights inside a block need no second-order term
  kWideWindow,       // shared curvature, wide windows
  kOwnCurvature,     // wide windows, each block has its own curvature
  kWeighted,         // kOwnCurvature, weighted by antenna beams: the fast variant of a job with beams
  kAtEdge,           // kOwnCurvature, weighted by the edge of a sector
  kWeightedAtEdge,   // kOwnCurvature, weighted by antenna beams and the edge of a sector
  kExactPath,        // each pixel in float64 (exact.hpp)
  kSkipped,          // the patch is outside the profile or the beams
  kVariants
};
constexpr bool kGrouped = kLanes == 16;  // narrow windows serve groups of four blocks

// Input of the pixel loop: pulses sorted by variant, and the path's polynomial (5b) of each pulse and block. Fields
// used for flat terrain are adjacent.
struct Batch {
  alignas(64) float path[kBatch][kBlocks];  // at the block's centre, in cells from the window's first cell
  alignas(64) float x[kBatch][kBlocks], y[kBatch][kBlocks];  // derivatives of `path`
  alignas(64) int32_t window[kBatch][kBlocks];               // first cell of the window, relative to `row`
  alignas(64) float shared_curvature[kBatch][16];            // x'^2 xx + x'y' xy + y'^2 yy at the pixels of any block
  const float* row[kBatch];                                  // table entry of the cell of the path to the patch origin
  int64_t order[kVariants][kBatch];                          // numbers of the pulses of each variant
  int64_t count[kVariants];
  alignas(64) float h[kBatch][kBlocks];          // derivative with respect to height
  alignas(64) float shared_slope_h[kBatch][16];  // x' xh + y' yh at the pixels of any block
  float shared_hh[kBatch];
  // Own curvature of each block: second-order coefficients, (5a).
  alignas(64) float xx[kBatch][kBlocks], xy[kBatch][kBlocks], yy[kBatch][kBlocks];
  alignas(64) float xh[kBatch][kBlocks], yh[kBatch][kBlocks], hh[kBatch][kBlocks];
  alignas(64) float weight[kBatch][kBlocks], weight_x[kBatch][kBlocks], weight_y[kBatch][kBlocks];  // of (7)
  float weight_h[kBatch];
  // Depth inside the sector, in widths of its edge: integration.md, (5).
  alignas(64) float depth[kBatch][kBlocks], depth_x[kBatch][kBlocks], depth_y[kBatch][kBlocks];
  float depth_h[kBatch], depth_xx[kBatch], depth_xy[kBatch], depth_yy[kBatch];  // second order at the origin
};

// x' and y': offsets of a block's pixels from its centre.
alignas(64) constexpr float kLaneX[16] = {-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f,
                                          -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f};
alignas(64) constexpr float kLaneY[16] = {-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f,
                                          .5f,   .5f,   .5f,   .5f,   1.5f, 1.5f, 1.5f, 1.5f};

// Expands the paths of one pulse about the patch's blocks and sets their look-up windows. Returns the variant of the
// pulse: a fast variant only if every index is inside its window and every window inside the table; otherwise, exact
// paths.
template <bool kTerrain, bool kCurvature>
inline Variant expand_paths(const ApertureJob& job, const Patch& patch, const OriginPaths& origin, int64_t pulse,
                            int64_t q, Batch& batch) {
  constexpr int64_t kParts = kBlocks / kLanes;
  const float first = origin.first_window[q], last = origin.last_window[q];
  LaneMask inside = kAllLanes, narrow = kAllLanes;
  Lanes path[kParts], low[kParts], lowest[kParts], high[kParts];
  for (int64_t part = 0; part < kParts; part++) {
    const int64_t b = part * kLanes;
    // (3) to (5): path and derivatives at the block centres, sum over both antennas.
    BlockPaths s;
    add_block_leg<kTerrain, kCurvature>(patch, origin.leg[0], q, b, s);
    add_block_leg<kTerrain, kCurvature>(patch, origin.leg[1], q, b, s);
    path[part] = s.path + origin.fraction[q];
    // Largest difference between a pixel's path and its block's: 1.5 pixels along both axes, heights and curvature.
    Lanes span = 1.5f * (magnitude(s.x) + magnitude(s.y)) + origin.curvature_bound[q];
    if constexpr (kTerrain) span += patch.rise_max * magnitude(s.h);
    high[part] = path[part] + span;
    low[part] = floor(path[part] - span);
    // A window starts at the lowest cell of its block or group; it must be inside the table and cover all paths.
    lowest[part] = kGrouped ? least_of_four(low[part]) : low[part];
    inside &= at_most(splat(first), low[part]) & at_most(low[part], splat(last)) &
              at_most(high[part] - low[part], splat(kWindow - apertura::kWindowMargin));
    narrow &= at_most(high[part] - lowest[part], splat(kNarrow - apertura::kWindowMargin));
    store(batch.x[q] + b, s.x), store(batch.y[q] + b, s.y);
    if constexpr (kTerrain) store(batch.h[q] + b, s.h);
    if constexpr (kCurvature) store(batch.xx[q] + b, s.xx), store(batch.xy[q] + b, s.xy), store(batch.yy[q] + b, s.yy);
    if constexpr (kCurvature && kTerrain)
      store(batch.xh[q] + b, s.xh), store(batch.yh[q] + b, s.yh), store(batch.hh[q] + b, s.hh);
  }
  if (!all(inside)) {
    // A patch entirely before or behind the profile has no echo in this pulse.
    LaneMask before = kAllLanes, behind = kAllLanes;
    for (int64_t part = 0; part < kParts; part++) {
      before &= at_most(high[part], splat(first - 1));
      behind &= at_most(splat(last + kWindow + 1), low[part]);
    }
    return all(before) || all(behind) ? kSkipped : kExactPath;
  }
  // Paths are counted from the first cell of the window, so that a rounded path is an index into it.
  const bool narrow_windows = !kCurvature && kLanes != 4 && all(narrow);
  for (int64_t part = 0; part < kParts; part++) {
    const Lanes begin = narrow_windows ? lowest[part] : low[part];
    store(batch.path[q] + part * kLanes, path[part] - begin);
    *reinterpret_cast<IntLanes*>(batch.window[q] + part * kLanes) = __builtin_convertvector(begin, IntLanes);
  }
  batch.row[q] = job.cells + (pulse + q) * 2 * (job.degree + 1) * job.width + int64_t(origin.whole[q]);
  if constexpr (kCurvature) return kOwnCurvature;
  // Shared curvature depends only on the position of a pixel in its block; it is computed once per pulse for all
  // blocks.
  for (int64_t lane = 0; lane < 16; lane += kLanes) {
    const Lanes x = load(kLaneX + lane), y = load(kLaneY + lane);
    store(batch.shared_curvature[q] + lane, x * (x * origin.xx[q] + y * origin.xy[q]) + y * y * origin.yy[q]);
    if constexpr (kTerrain) store(batch.shared_slope_h[q] + lane, x * origin.xh[q] + y * origin.yh[q]);
  }
  batch.shared_hh[q] = origin.hh[q];
  if (!narrow_windows) return kWideWindow;
  return kTerrain && origin.linear_heights[q] ? kLinearHeights : kSharedCurvature;
}

// Sorts eight pulses by their path variant.
template <bool kTerrain>
inline void sort_pulses(const ApertureJob& job, const Patch& patch, int64_t pulse, int64_t pulses, Batch& batch) {
  OriginPaths origin;
  find_origin_paths<kTerrain>(job, patch, pulse, origin);
  constexpr Variant kMost = kTerrain ? kLinearHeights : kSharedCurvature;
  int64_t most = 0;  // counted in a register: nearly all pulses have this variant
  for (int64_t variant = 0; variant < kVariants; variant++) batch.count[variant] = 0;
  for (int64_t q = 0; q < pulses; q++) {
    Variant variant = kExactPath;
    if (origin.holds[q] == 2)
      variant = expand_paths<kTerrain, false>(job, patch, origin, pulse, q, batch);
    else if (origin.holds[q] == 1)
      variant = expand_paths<kTerrain, true>(job, patch, origin, pulse, q, batch);
    if (variant == kMost)
      batch.order[kMost][most++] = q;
    else
      batch.order[variant][batch.count[variant]++] = q;
  }
  batch.count[kMost] = most;
}

// Path of a block's pixels by (5b), in cells from the first cell of its window.
template <bool kTerrain, Variant kVariant>
inline Lanes pixel_paths(const Patch& patch, const Batch& batch, int64_t q, int64_t b, int64_t part) {
  const Lanes x = load(kLaneX + part), y = load(kLaneY + part);
  Lanes t;
  if constexpr (kVariant >= kOwnCurvature)
    t = batch.path[q][b] + x * (batch.x[q][b] + x * batch.xx[q][b] + y * batch.xy[q][b]) +
        y * (batch.y[q][b] + y * batch.yy[q][b]);
  else
    t = (load(batch.shared_curvature[q] + part) + batch.path[q][b]) + x * batch.x[q][b] + y * batch.y[q][b];
  if constexpr (kTerrain) {
    const Lanes rise = load(patch.rise + b * 16 + part);
    if constexpr (kVariant == kLinearHeights)
      t += rise * batch.h[q][b];
    else if constexpr (kVariant >= kOwnCurvature)
      t += rise * (batch.h[q][b] + x * batch.xh[q][b] + y * batch.yh[q][b] + rise * batch.hh[q][b]);
    else
      t += rise * (load(batch.shared_slope_h[q] + part) + batch.h[q][b] + rise * batch.shared_hh[q]);
  }
  return t;
}

// First group of blocks from `group` on that contains pixels, or kBlocks.
template <int64_t kBundle>
inline int64_t next_present(const Patch& patch, int64_t group) {
  while (group < kBlocks && !patch.present[group]) group += kBundle;
  return group;
}

// Pixel loop: adds all pulses of one variant to the blocks of each window. `sum` contains re, then im, block by block.
template <class Phase, int64_t kDegree, bool kTerrain, Variant kVariant>
inline void add_pulses(const ApertureJob& job, const Patch& patch, const Batch& batch, float* sum) {
  constexpr bool kWide = kVariant != kSharedCurvature && kVariant != kLinearHeights;
  constexpr int64_t kParts = 16 / kLanes, kBundle = kGrouped && !kWide ? 4 : 1, kVectors = kBundle * kParts;
  constexpr bool kAhead = kGrouped && !kWide;  // 32 registers also suffice for the pixels' paths of the next pulse
  const int64_t count = batch.count[kVariant], width = job.width, *order = batch.order[kVariant];
  if (count == 0) return;
  const Phase phase(job.phase_coefficients);
  // Path t of each pixel by (5b); its cell i = round(t) is in the low bits of t + 1.5 2^23, and u = t - i is the
  // position in the cell. Both are computed early to hide latency: one pulse ahead if there are enough registers,
  // otherwise for all vectors of a pulse before its first look-up.
  Lanes place[kVectors];
  IntLanes index[kVectors];
  const auto find_place = [&](int64_t q, int64_t group, int64_t v) {
    const Lanes t = pixel_paths<kTerrain, kVariant>(patch, batch, q, group + v / kParts, v % kParts * kLanes);
    const Lanes rounded = t + kRounder;
    place[v] = t - (rounded - kRounder), index[v] = (IntLanes)rounded;
  };
  int64_t group = next_present<kBundle>(patch, 0);
  for (int64_t v = 0; kAhead && group < kBlocks && v < kVectors; v++) find_place(order[0], group, v);
  for (int64_t after; group < kBlocks; group = after) {
    after = next_present<kBundle>(patch, group + kBundle);
    // The image of these blocks stays in registers over all pulses.
    Lanes re[kVectors], im[kVectors];
    float* here = sum + group * 16;
    for (int64_t v = 0; v < kVectors; v++) re[v] = load(here + v * kLanes), im[v] = load(here + kPixels + v * kLanes);
    for (int64_t n = 0; n < count; n++) {
      // The window of this pulse: a_0, a_1, a_2 of (2) at up to 16 cells, each part of each coefficient in a register.
      const int64_t q = order[n];
      const float* window = batch.row[q] + batch.window[q][group];
      const WindowCells<kWide> re0(window), im0(window + width), re1(window + 2 * width), im1(window + 3 * width);
      const WindowCells<kWide> re2(kDegree == 2 ? window + 4 * width : window);
      const WindowCells<kWide> im2(kDegree == 2 ? window + 5 * width : window);
      // The pulse after the last one is the first one of the next group.
      const bool last = n + 1 == count;
      const int64_t next = order[last ? 0 : n + 1], next_group = last && after < kBlocks ? after : group;
#pragma GCC unroll 4
      for (int64_t v = 0; !kAhead && v < kVectors; v++) find_place(q, group, v);
#pragma GCC unroll 4
      for (int64_t v = 0; v < kVectors; v++) {
        const Lanes u = place[v];
        const IntLanes cell = index[v];
        if constexpr (kAhead) find_place(next, next_group, v);
        // (2): the echo at the pixel's path, a_0 + a_1 u + a_2 u^2, including the carrier at the centre of the cell.
        Lanes vr = re1[cell], vi = im1[cell], cosine, sine;
        if constexpr (kDegree == 2) vr += u * re2[cell], vi += u * im2[cell];
        vr = re0[cell] + u * vr, vi = im0[cell] + u * vi;
        if constexpr (kVariant == kAtEdge || kVariant == kWeightedAtEdge) {
          // integration.md, (3): the sector's weight at the pixel.
          const int64_t b = group + v / kParts, part = v % kParts * kLanes;
          const Lanes x = load(kLaneX + part), y = load(kLaneY + part);
          Lanes depth = x * (batch.depth_x[q][b] + x * batch.depth_xx[q] + y * batch.depth_xy[q]) +
                        y * (batch.depth_y[q][b] + y * batch.depth_yy[q]) + batch.depth[q][b];
          if constexpr (kTerrain) depth += load(patch.rise + b * 16 + part) * batch.depth_h[q];
          depth = within_unit(depth);
          depth *= depth * (3.0f - 2.0f * depth);
          vr *= depth, vi *= depth;
        }
        if constexpr (kVariant == kWeighted || kVariant == kWeightedAtEdge) {
          // (7): the gain of both antennas at the pixel.
          const int64_t b = group + v / kParts, part = v % kParts * kLanes;
          Lanes weight = load(kLaneX + part) * batch.weight_x[q][b] + load(kLaneY + part) * batch.weight_y[q][b] +
                         batch.weight[q][b];
          if constexpr (kTerrain) weight += load(patch.rise + b * 16 + part) * batch.weight_h[q];
          vr *= weight, vi *= weight;
        }
        // The residual carrier inside the cell, exp(j omega u), and the sum over pulses, (1).
        phase(u, cosine, sine);
        re[v] += vr * cosine, im[v] += vr * sine;
        re[v] -= vi * sine, im[v] += vi * cosine;
      }
    }
    for (int64_t v = 0; v < kVectors; v++) store(here + v * kLanes, re[v]), store(here + kPixels + v * kLanes, im[v]);
  }
}

}  // namespace
