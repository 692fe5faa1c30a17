// Eight pulses over one patch: which form each pulse may take, and the pixel loop of the fast forms.
#pragma once
#include "lanes.hpp"
#include "paths.hpp"
#include "phase.hpp"

namespace {

// Fast forms: one look-up window for a group of four blocks (one block with 8 lanes), or a wide one for each block; all
// blocks bend alike, or each its own way; shallow: heights inside a block need no curvature. Where antennas weigh, pulses that may go fast all go the one way that holds
// for all of them.
constexpr bool kGrouped = kLanes == 16;
// Fast forms but for the first two bend block by block.
enum Form { kShared, kShallow, kSharedWide, kOwn, kWeighted, kExact, kSkip, kForms };

struct Batch {
  alignas(64) float path[kBatch][kBlocks];  // at the centre, from the window's first cell
  alignas(64) float x[kBatch][kBlocks], y[kBatch][kBlocks], h[kBatch][kBlocks];  // its derivatives
  alignas(64) float xx[kBatch][kBlocks], xy[kBatch][kBlocks], yy[kBatch][kBlocks];
  alignas(64) float xh[kBatch][kBlocks], yh[kBatch][kBlocks], hh[kBatch][kBlocks];
  alignas(64) int32_t window[kBatch][kBlocks];  // first cell, from `row`
  alignas(64) float bend[kBatch][16];           // shared curvature over the pixels of any block
  alignas(64) float tilt[kBatch][16];           // shared change of the height slope over them
  float lift[kBatch];                           // shared second derivative along the height
  alignas(64) float weight[kBatch][kBlocks], weight_x[kBatch][kBlocks], weight_y[kBatch][kBlocks];  // of the antennas
  float weight_h[kBatch];
  const float* row[kBatch];
  int order[kForms][kBatch];
  int count[kForms];
};

// Pixels of a block from its centre.
alignas(64) constexpr float kLaneX[16] = {-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f,
                                          -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f};
alignas(64) constexpr float kLaneY[16] = {-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f,
                                          .5f,   .5f,   .5f,   .5f,   1.5f, 1.5f, 1.5f, 1.5f};

// Places the look-up windows of one pulse. Returns the form it may take: every index stays inside its window and
// every window inside the table, or the pulse goes the exact way.
template <bool kTerrain, bool kOwnCurvature>
inline Form place(const ApertureJob& job, const Patch& patch, const Aim& aim, int64_t pulse, int q, Batch& batch) {
  constexpr int kParts = kBlocks / kLanes;
  const float rough = patch.roughest, first = aim.first[q], last = aim.last[q];
  Truth inside = kTrue, narrow = kTrue;
  Lanes path[kParts], low[kParts], lowest[kParts], top[kParts];
  for (int part = 0; part < kParts; part++) {
    const int b = part * kLanes;
    Slope s;
    add_leg<kTerrain, kOwnCurvature>(patch, aim.leg[0], q, b, s);
    add_leg<kTerrain, kOwnCurvature>(patch, aim.leg[1], q, b, s);
    path[part] = s.path + aim.rest[q];
    Lanes span = 1.5f * (magnitude(s.x) + magnitude(s.y)) + aim.margin[q];
    if constexpr (kTerrain) span += rough * magnitude(s.h);
    top[part] = path[part] + span;
    low[part] = floor(path[part] - span);
    lowest[part] = kGrouped ? least_of_four(low[part]) : low[part];
    inside &= at_most(splat(first), low[part]) & at_most(low[part], splat(last)) &
              at_most(top[part] - low[part], splat(kWindow - 0.51f));
    narrow &= at_most(top[part] - lowest[part], splat(kNarrow - 0.51f));
    store(batch.x[q] + b, s.x), store(batch.y[q] + b, s.y);
    if constexpr (kTerrain) store(batch.h[q] + b, s.h);
    if constexpr (kOwnCurvature)
      store(batch.xx[q] + b, s.xx), store(batch.xy[q] + b, s.xy), store(batch.yy[q] + b, s.yy);
    if constexpr (kOwnCurvature && kTerrain)
      store(batch.xh[q] + b, s.xh), store(batch.yh[q] + b, s.yh), store(batch.hh[q] + b, s.hh);
  }
  if (!all(inside)) {
    Truth before = kTrue, behind = kTrue;
    for (int part = 0; part < kParts; part++) {
      before &= at_most(top[part], splat(first - 1));
      behind &= at_most(splat(last + kWindow + 1), low[part]);
    }
    return all(before) || all(behind) ? kSkip : kExact;
  }
  const bool shared = !kOwnCurvature && kLanes != 4 && all(narrow);
  for (int part = 0; part < kParts; part++) {
    const Lanes begin = shared ? lowest[part] : low[part];
    store(batch.path[q] + part * kLanes, path[part] - begin);
    *reinterpret_cast<Whole*>(batch.window[q] + part * kLanes) = __builtin_convertvector(begin, Whole);
  }
  batch.row[q] = job.cells + (pulse + q) * 2 * (job.degree + 1) * job.width + int64_t(aim.start[q]);
  if constexpr (kOwnCurvature) return kOwn;
  for (int lane = 0; lane < 16; lane += kLanes) {
    const Lanes x = load(kLaneX + lane), y = load(kLaneY + lane);
    store(batch.bend[q] + lane, x * (x * aim.xx[q] + y * aim.xy[q]) + y * y * aim.yy[q]);
    if constexpr (kTerrain) store(batch.tilt[q] + lane, x * aim.xh[q] + y * aim.yh[q]);
  }
  batch.lift[q] = aim.hh[q];
  if (!shared) return kSharedWide;
  return kTerrain && aim.shallow[q] ? kShallow : kShared;
}

// Sorts eight pulses into forms.
template <bool kTerrain>
inline void sort_pulses(const ApertureJob& job, const Patch& patch, int64_t pulse, int pulses, Batch& batch) {
  Aim aim;
  aim_at<kTerrain>(job, patch, pulse, aim);
  constexpr Form kMost = kTerrain ? kShallow : kShared;
  int most = 0;  // in a register: nearly all pulses take this form
  for (int form = 0; form < kForms; form++) batch.count[form] = 0;
  for (int q = 0; q < pulses; q++) {
    Form form = kExact;
    if (aim.holds[q] == 2)
      form = place<kTerrain, false>(job, patch, aim, pulse, q, batch);
    else if (aim.holds[q] == 1)
      form = place<kTerrain, true>(job, patch, aim, pulse, q, batch);
    if (form == kMost)
      batch.order[kMost][most++] = q;
    else
      batch.order[form][batch.count[form]++] = q;
  }
  batch.count[kMost] = most;
}

// Path of a block's pixels, in cells from its window.
template <bool kTerrain, Form kForm>
inline Lanes place_pixels(const Patch& patch, const Batch& batch, int q, int b, int part) {
  const Lanes x = load(kLaneX + part), y = load(kLaneY + part);
  Lanes t;
  if constexpr (kForm >= kOwn)
    t = batch.path[q][b] + x * (batch.x[q][b] + x * batch.xx[q][b] + y * batch.xy[q][b]) +
        y * (batch.y[q][b] + y * batch.yy[q][b]);
  else
    t = (load(batch.bend[q] + part) + batch.path[q][b]) + x * batch.x[q][b] + y * batch.y[q][b];
  if constexpr (kTerrain) {
    const Lanes rise = load(patch.rise + b * 16 + part);
    if constexpr (kForm == kShallow)
      t += rise * batch.h[q][b];
    else if constexpr (kForm >= kOwn)
      t += rise * (batch.h[q][b] + x * batch.xh[q][b] + y * batch.yh[q][b] + rise * batch.hh[q][b]);
    else
      t += rise * (load(batch.tilt[q] + part) + batch.h[q][b] + rise * batch.lift[q]);
  }
  return t;
}

// The pixel loop: for each window's blocks, all pulses of one form. `sum` is re then im, block by block.
template <class Phase, int kDegree, bool kTerrain, Form kForm>
inline void add_form(const ApertureJob& job, const Patch& patch, const Batch& batch, float* sum) {
  constexpr bool kWide = kForm != kShared && kForm != kShallow;
  constexpr int kParts = 16 / kLanes, kBundle = kGrouped && !kWide ? 4 : 1, kVectors = kBundle * kParts;
  const int count = batch.count[kForm];
  if (count == 0) return;
  const Phase phase(job.phase);
  const int64_t width = job.width;
  for (int group = 0; group < kBlocks; group += kBundle) {
    if (!patch.present[group]) continue;
    Lanes re[kVectors], im[kVectors];
    float* here = sum + group * 16;
    for (int v = 0; v < kVectors; v++) re[v] = load(here + v * kLanes), im[v] = load(here + kPixels + v * kLanes);
    for (int n = 0; n < count; n++) {
      const int q = batch.order[kForm][n];
      const float* window = batch.row[q] + batch.window[q][group];
      const Stretch<kWide> re0(window), im0(window + width), re1(window + 2 * width), im1(window + 3 * width);
      const Stretch<kWide> re2(kDegree == 2 ? window + 4 * width : window), im2(kDegree == 2 ? window + 5 * width : window);
      Lanes u[kVectors];  // all places before the first look-up, so that no vector waits for its own
      Whole index[kVectors];
#pragma GCC unroll 4
      for (int v = 0; v < kVectors; v++) {
        const Lanes t = place_pixels<kTerrain, kForm>(patch, batch, q, group + v / kParts, v % kParts * kLanes);
        const Lanes moved = t + kMagic;
        u[v] = t - (moved - kMagic), index[v] = (Whole)moved;
      }
#pragma GCC unroll 4
      for (int v = 0; v < kVectors; v++) {
        Lanes vr = re1[index[v]], vi = im1[index[v]], cosine, sine;
        if constexpr (kDegree == 2) vr += u[v] * re2[index[v]], vi += u[v] * im2[index[v]];
        vr = re0[index[v]] + u[v] * vr, vi = im0[index[v]] + u[v] * vi;
        if constexpr (kForm == kWeighted) {
          const int b = group + v / kParts, part = v % kParts * kLanes;
          Lanes weight = load(kLaneX + part) * batch.weight_x[q][b] + load(kLaneY + part) * batch.weight_y[q][b] +
                         batch.weight[q][b];
          if constexpr (kTerrain) weight += load(patch.rise + b * 16 + part) * batch.weight_h[q];
          vr *= weight, vi *= weight;
        }
        phase(u[v], cosine, sine);
        re[v] += vr * cosine, im[v] += vr * sine;
        re[v] -= vi * sine, im[v] += vi * cosine;
      }
    }
    for (int v = 0; v < kVectors; v++) store(here + v * kLanes, re[v]), store(here + kPixels + v * kLanes, im[v]);
  }
}

}  // namespace
