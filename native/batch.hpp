// Eight pulses over one patch: which form each pulse may take, and the pixel loop of the fast forms.
#pragma once
#include "lanes.hpp"
#include "paths.hpp"
#include "phase.hpp"

namespace {

enum Form { kShared, kSharedWide, kOwn, kFast, kExact = kFast, kSkip, kForms };

struct Batch {
  Slopes slopes[kBatch];
  alignas(64) const float* window[kBatch][kBlocks];
  alignas(64) float bend[kBatch][16];   // shared curvature over the pixels of any block
  alignas(64) float tilt[kBatch][16];   // shared change of the height slope over them
  float lift[kBatch];                   // shared second derivative along the height
  int order[kForms][kBatch];
  int count[kForms];
};

constexpr float kOffset[4] = {-1.5f, -0.5f, 0.5f, 1.5f};

inline float magnitude(float value) { return __builtin_fabsf(value); }

template <bool kTerrain>
inline void slopes_of(const Patch& patch, const Aim& aim, int q, bool own, Slopes& out) {
  const float start = float(aim.path[q] - __builtin_floor(aim.path[q]));
  for (int b = 0; b < kBlocks; b++) out.path[b] = out.x[b] = out.y[b] = out.h[b] = 0;
  for (const Leg& leg : aim.leg) add_leg<kTerrain>(patch, leg.x[q], leg.y[q], leg.h[q], leg.inverse[q], out);
  for (int b = 0; b < kBlocks; b++) out.path[b] += start;
  if (!own) return;
  for (int b = 0; b < kBlocks; b++) out.xx[b] = out.xy[b] = out.yy[b] = out.xh[b] = out.yh[b] = out.hh[b] = 0;
  for (const Leg& leg : aim.leg) add_curvature<kTerrain>(patch, leg.x[q], leg.y[q], leg.h[q], leg.inverse[q], out);
}

// Places the look-up windows of one pulse. Returns the form it may take: every index stays inside its window and
// every window inside the table, or the pulse goes the exact way.
template <bool kTerrain>
inline Form place(const ApertureJob& job, const Patch& patch, const Aim& aim, int64_t pulse, int q, bool own,
                  Batch& batch) {
  Slopes& s = batch.slopes[q];
  slopes_of<kTerrain>(patch, aim, q, own, s);
  const Curvature c = shared_curvature(patch, aim, q);
  const float rough = patch.roughest;
  // Curvature inside a block is small beside its slope: twice the value at the origin bounds it where fast forms hold.
  float margin = 4.5f * (magnitude(c.xx) + magnitude(c.xy) + magnitude(c.yy)) + 1e-3f;
  if constexpr (kTerrain) margin += rough * (3.0f * (magnitude(c.xh) + magnitude(c.yh)) + 2 * rough * c.hh);
  alignas(64) float low[kBlocks];
  float widest = 0, lowest = 1e30f, highest = -1e30f;
  for (int b = 0; b < kBlocks; b++) {
    float span = 1.5f * (magnitude(s.x[b]) + magnitude(s.y[b])) + margin;
    if constexpr (kTerrain) span += rough * magnitude(s.h[b]);
    low[b] = __builtin_floorf(s.path[b] - span);
    const float end = s.path[b] + span - low[b], top = s.path[b] + span;
    s.path[b] -= low[b];
    widest = widest < end ? end : widest;
    lowest = lowest > low[b] ? low[b] : lowest;
    highest = highest < top ? top : highest;
  }
  const double start = __builtin_floor(aim.path[q]);
  if (start + highest < -1 || start + lowest > double(job.width)) return kSkip;
  if (!(start + lowest >= 0 && start + highest + kWindow <= double(job.width) && widest <= kWindow - 0.51f))
    return kExact;
  const float* row = job.cells + (pulse + q) * 2 * (job.degree + 1) * job.width + int64_t(start);
  for (int b = 0; b < kBlocks; b++) batch.window[q][b] = row + int64_t(low[b]);
  if (own) return kOwn;
  for (int lane = 0; lane < 16; lane++) {
    const float x = kOffset[lane % 4], y = kOffset[lane / 4];
    batch.bend[q][lane] = x * (x * c.xx + y * c.xy) + y * y * c.yy;
    if constexpr (kTerrain) batch.tilt[q][lane] = x * c.xh + y * c.yh;
  }
  batch.lift[q] = c.hh;
  return widest <= kNarrow - 0.51f ? kShared : kSharedWide;
}

// Sorts eight pulses into forms.
template <bool kTerrain>
inline void sort_pulses(const ApertureJob& job, const Patch& patch, int64_t pulse, int pulses, Batch& batch) {
  Aim aim;
  aim_at(job, patch, pulse, aim);
  const float tolerance = float(job.tolerance_rad / job.radians_per_cell);
  for (int form = 0; form < kForms; form++) batch.count[form] = 0;
  for (int q = 0; q < pulses; q++) {
    Form form = kExact;
    const bool own = !(aim.shared[q] <= tolerance);
    const bool far = !(magnitude(float(aim.path[q])) < 1e7f);
    if (!patch.crooked && !far && aim.own[q] <= tolerance)
      form = place<kTerrain>(job, patch, aim, pulse, q, own, batch);
    batch.order[form][batch.count[form]++] = q;
  }
}

// The pixel loop: for each block, all pulses of one form. `sum` is re then im, block by block.
template <class Phase, int kDegree, bool kTerrain, Form kForm>
inline void add_form(const ApertureJob& job, const Patch& patch, const Batch& batch, float* sum) {
  constexpr bool kWide = kForm != kShared;
  const int count = batch.count[kForm];
  if (count == 0) return;
  const Phase phase(job.phase);
  const int64_t width = job.width;
  alignas(64) float lane_x[16], lane_y[16];
  for (int lane = 0; lane < 16; lane++) lane_x[lane] = kOffset[lane % 4], lane_y[lane] = kOffset[lane / 4];
  for (int n = 0; n < patch.blocks; n++) {
    const int b = patch.block[n];
    constexpr int kParts = 16 / kLanes;
    Lanes re[kParts], im[kParts];
    for (int part = 0; part < kParts; part++) {
      re[part] = load(sum + b * 16 + part * kLanes);
      im[part] = load(sum + kPixels + b * 16 + part * kLanes);
    }
    for (int n_q = 0; n_q < count; n_q++) {
      const int q = batch.order[kForm][n_q];
      const Slopes& s = batch.slopes[q];
      const float* window = batch.window[q][b];
#pragma GCC unroll 4
      for (int part = 0; part < kParts; part++) {
        const Lanes x = load(lane_x + part * kLanes), y = load(lane_y + part * kLanes);
        Lanes t;
        if constexpr (kForm == kOwn)
          t = s.path[b] + x * (s.x[b] + x * s.xx[b] + y * s.xy[b]) + y * (s.y[b] + y * s.yy[b]);
        else
          t = (load(batch.bend[q] + part * kLanes) + s.path[b]) + x * s.x[b] + y * s.y[b];
        if constexpr (kTerrain) {
          const Lanes rise = load(patch.rise + b * 16 + part * kLanes);
          if constexpr (kForm == kOwn)
            t += rise * (s.h[b] + x * s.xh[b] + y * s.yh[b] + rise * s.hh[b]);
          else
            t += rise * (load(batch.tilt[q] + part * kLanes) + s.h[b] + rise * batch.lift[q]);
        }
        const Lanes moved = t + kMagic, u = t - (moved - kMagic);
        const Whole index = (Whole)moved;
        Lanes vr = look_up<kWide>(window + 2 * width, index), vi = look_up<kWide>(window + 3 * width, index);
        if constexpr (kDegree == 2) {
          vr += u * look_up<kWide>(window + 4 * width, index);
          vi += u * look_up<kWide>(window + 5 * width, index);
        }
        vr = look_up<kWide>(window, index) + u * vr;
        vi = look_up<kWide>(window + width, index) + u * vi;
        Lanes cosine, sine;
        phase(u, cosine, sine);
        re[part] += vr * cosine - vi * sine;
        im[part] += vr * sine + vi * cosine;
      }
    }
    for (int part = 0; part < kParts; part++) {
      store(sum + b * 16 + part * kLanes, re[part]);
      store(sum + kPixels + b * 16 + part * kLanes, im[part]);
    }
  }
}

}  // namespace
