// Weight of antennas whose beams turn with the pulses: at eleven nodes of a patch, then as polynomials of its blocks;
// pixel by pixel where that would not do. docs/theory/engine.md says how well.
#pragma once
#include "batch.hpp"
#include "exact.hpp"

namespace {

constexpr int kNodes = 11;  // 3 x 3 over the plane of a patch, row by row; with heights, its middle lowered and raised
enum Sight { kRough, kSmooth, kDark };

// Antenna's axes and what it sees of a patch, eight pulses at once.
struct View {
  alignas(64) float gain[kNodes][kBatch];                               // of all antennas so far
  alignas(64) float low[2][kBatch], high[2][kBatch];                    // angles of this one: azimuth, elevation
  alignas(64) float ahead[kBatch];                                      // how far at most it lies before the antenna
  alignas(64) int32_t dark[kBatch], smooth[kBatch];
};

// atan2 to 1e-7 rad, without a branch.
inline float angle(float y, float x) {
  const float a = magnitude(x), b = magnitude(y);
  const float z = (a < b ? a : b) / ((a < b ? b : a) + 1e-30f), s = z * z;
  float turn = z * (0.99999934f + s * (-0.33329861f + s * (0.19946566f + s * (-0.13908629f +
               s * (0.09642196f + s * (-0.05591232f + s * (0.02186295f + s * -0.00405457f)))))));
  turn = b > a ? 1.57079633f - turn : turn;
  turn = x < 0 ? 3.14159265f - turn : turn;
  return y < 0 ? -turn : turn;
}

// Gain at `place` samples from the first of a pattern, linear between samples and zero beyond.
inline float look_up(const BeamJob& beam, int which, float place) {
  const int64_t last = beam.count[which] - 1;
  const bool inside = place >= 0 && place <= float(last);
  const float held = inside ? place : 0;
  const int32_t at = int32_t(held) < int32_t(last) ? int32_t(held) : int32_t(last) - 1;
  const float *gain = beam.gain[which] + at, part = held - float(at);
  return inside ? gain[0] + part * (gain[1] - gain[0]) : 0;
}

inline float sample(const BeamJob& beam, int which, float radians) {
  return (radians - float(beam.first_rad[which])) * float(beam.samples_per_rad[which]);
}

// From antennas to a patch along their axes, in cells: its origin, and the steps from node to node.
struct Facing {
  alignas(64) float along[3][kBatch], step_x[3][kBatch], step_y[3][kBatch], up[3][kBatch];
};

inline void face(const BeamJob& beam, const double* antenna, const ApertureJob& job, const Patch& patch, int64_t pulse,
                 Facing& to) {
  const int64_t n = job.padded;
  const float half_x = apertura::half(patch.columns), half_y = apertura::half(patch.rows);
  for (int axis = 0; axis < 3; axis++) {
    const double *x = beam.axes + 3 * axis * n + pulse, *y = x + n, *z = y + n;
    for (int q = 0; q < kBatch; q++) {
      const double wx = patch.origin[0] - antenna[pulse + q], wy = patch.origin[1] - antenna[n + pulse + q],
                   wz = patch.origin[2] - antenna[2 * n + pulse + q];
      to.along[axis][q] = float((wx * x[q] + wy * y[q] + wz * z[q]) * job.cells_per_metre);
      to.step_x[axis][q] = half_x * float(patch.step_x[0] * x[q] + patch.step_x[1] * y[q] + patch.step_x[2] * z[q]);
      to.step_y[axis][q] = half_y * float(patch.step_y[0] * x[q] + patch.step_y[1] * y[q] + patch.step_y[2] * z[q]);
      to.up[axis][q] = patch.tallest * float(patch.up[0] * x[q] + patch.up[1] * y[q] + patch.up[2] * z[q]);
    }
  }
}

// Marks pulses whose patch lies outside the narrowest cone about the boresight that holds the pattern: no angle is taken.
inline void pass_over(const BeamJob& beam, const Facing& to, int32_t* dark) {
  float edge[2];
  for (int which = 0; which < 2; which++) {
    const double first = beam.first_rad[which], last = first + double(beam.count[which] - 1) / beam.samples_per_rad[which];
    edge[which] = __builtin_cosf(float(last < -first ? -first : last));
  }
  const float widest = edge[0] < 0 ? edge[0] : edge[0] * (edge[1] < 0 ? 0 : edge[1]);
  const auto length = [](const float (*v)[kBatch], int q) {
    return __builtin_sqrtf(v[0][q] * v[0][q] + v[1][q] * v[1][q] + v[2][q] * v[2][q]);
  };
  for (int q = 0; q < kBatch; q++) {
    const float far = length(to.along, q), reach = length(to.step_x, q) + length(to.step_y, q) + length(to.up, q);
    dark[q] |= to.along[0][q] + reach < widest * (widest < 0 ? far + reach : far - reach) - 1e-3f * far;
  }
}

// Gains at the nodes of a patch, and the angles they span.
inline void view(const BeamJob& beam, const Patch& patch, const Facing& to, View& out) {
  for (int node = 0; node < (patch.terrain ? kNodes : 9); node++) {
    const float x = node < 9 ? float(node % 3 - 1) : 0, y = node < 9 ? float(node / 3 - 1) : 0;
    const float h = node < 9 ? 0 : float(2 * node - 19);
    alignas(64) float place[2][kBatch];
    for (int q = 0; q < kBatch; q++) {
      float v[3];
      for (int axis = 0; axis < 3; axis++)
        v[axis] = to.along[axis][q] + x * to.step_x[axis][q] + y * to.step_y[axis][q] + h * to.up[axis][q];
      out.ahead[q] = node && !(v[0] > out.ahead[q]) ? out.ahead[q] : v[0];
      place[0][q] = sample(beam, 0, angle(v[1], v[0]));
      place[1][q] = sample(beam, 1, angle(v[2], __builtin_sqrtf(v[0] * v[0] + v[1] * v[1])));
    }
    for (int which = 0; which < 2; which++)
      for (int q = 0; q < kBatch; q++) {
        const float at = place[which][q];
        out.gain[node][q] *= look_up(beam, which, at);
        out.low[which][q] = node && !(at < out.low[which][q]) ? out.low[which][q] : at;  // a NaN at the origin stays
        out.high[which][q] = node && !(at > out.high[which][q]) ? out.high[which][q] : at;
      }
  }
}

// Whether all of a patch lies inside or outside the pattern.
inline void judge(const BeamJob& beam, const Facing& to, View& out) {
  const bool forward = beam.first_rad[0] >= -1.5708 &&
                       beam.first_rad[0] + double(beam.count[0] - 1) / beam.samples_per_rad[0] <= 1.5708;
  for (int q = 0; q < kBatch; q++) out.dark[q] |= forward && out.ahead[q] + magnitude(to.up[0][q]) < -1e-3f;
  for (int which = 0; which < 2; which++) {
    const float last = float(beam.count[which] - 1), radian = float(beam.samples_per_rad[which]);
    for (int q = 0; q < kBatch; q++) {
      // Between nodes an angle exceeds theirs by less than half of what they span.
      const float low = out.low[which][q], high = out.high[which][q], beyond = 1e-3f + 0.5f * (high - low);
      const bool near = high - low <= radian;  // not around the pole or the cut at half a turn
      out.dark[q] |= near && (high + beyond < 0 || low - beyond > last);
      out.smooth[q] &= near && low - beyond >= 0 && high + beyond <= last;
    }
  }
}

// The biquadratic through the gains of one pulse at the nodes: value and slope in each block. Returns whether it holds.
inline bool spread(const Patch& patch, const float* g, float peak, int q, Batch& batch) {
  float level[3], slope[3], bow[3], change = 0, bend = 0;
  const auto span = [&](float a, float b, float c) {
    const float first = magnitude(c - a), second = magnitude(a - 2 * b + c);
    change = first <= change ? change : first, bend = second <= bend ? bend : second;
  };
  for (int i = 0; i < 3; i++) {
    span(g[3 * i], g[3 * i + 1], g[3 * i + 2]), span(g[i], g[3 + i], g[6 + i]);
    level[i] = g[3 * i + 1], slope[i] = 0.5f * (g[3 * i + 2] - g[3 * i]);
    bow[i] = 0.5f * (g[3 * i] + g[3 * i + 2]) - g[3 * i + 1];
  }
  if (patch.terrain) span(g[9], g[4], g[10]);
  if (!(change <= 0.12f * peak && bend <= 0.025f * peak)) return false;
  const float per_x = 1 / apertura::half(patch.columns), per_y = 1 / apertura::half(patch.rows);
  const float rise = patch.terrain ? 0.5f * (g[10] - g[9]) / patch.tallest : 0;
  batch.weight_h[q] = rise;
  for (int b = 0; b < kBlocks; b += kLanes) {
    const Lanes x = load(patch.along_x + b) * per_x, y = load(patch.along_y + b) * per_y;
    Lanes value[3], turn[3];
    for (int i = 0; i < 3; i++) value[i] = level[i] + x * (slope[i] + x * bow[i]), turn[i] = slope[i] + 2 * x * bow[i];
    const Lanes fall = 0.5f * (value[2] - value[0]), sag = 0.5f * (value[0] + value[2]) - value[1];
    const Lanes swing = 0.5f * (turn[2] - turn[0]), dip = 0.5f * (turn[0] + turn[2]) - turn[1];
    store(batch.weight[q] + b, value[1] + y * (fall + y * sag) + rise * load(patch.height + b));
    store(batch.weight_x[q] + b, per_x * (turn[1] + y * (swing + y * dip)));
    store(batch.weight_y[q] + b, per_y * (fall + 2 * y * sag));
  }
  return true;
}

// Weights of eight pulses over the blocks of a patch, and how each may be taken.
inline void weigh(const ApertureJob& job, const Patch& patch, int64_t pulse, Batch& batch, Sight* sight) {
  View seen;
  Facing to[2];
  float peak = 1;
  int lit = 0;
  for (int q = 0; q < kBatch; q++) seen.dark[q] = 0, seen.smooth[q] = 1;
  for (int leg = 0; leg < 2; leg++)
    if (const BeamJob* beam = job.beam[leg]) {
      face(*beam, leg ? job.receiver : job.transmitter, job, patch, pulse, to[leg]);
      pass_over(*beam, to[leg], seen.dark);
    }
  for (int q = 0; q < kBatch; q++) sight[q] = kDark, lit |= patch.crooked || !seen.dark[q];
  if (!lit) return;
  for (int node = 0; node < kNodes; node++)
    for (int q = 0; q < kBatch; q++) seen.gain[node][q] = 1;
  for (int leg = 0; leg < 2; leg++)
    if (const BeamJob* beam = job.beam[leg]) {
      view(*beam, patch, to[leg], seen);
      judge(*beam, to[leg], seen);
      peak *= float(beam->peak);
    }
  for (int q = 0; q < kBatch; q++) {
    float g[kNodes];
    for (int node = 0; node < kNodes; node++) g[node] = seen.gain[node][q];
    if (patch.crooked || !seen.dark[q])
      sight[q] = seen.smooth[q] && spread(patch, g, peak, q, batch) ? kSmooth : kRough;
  }
}

// Weight of one pulse at each pixel of a patch.
inline void weigh_exactly(const ApertureJob& job, const Positions& at, int64_t pulse, float* weight) {
  const int64_t n = job.padded;
  for (int slot = 0; slot < kPixels; slot++) weight[slot] = 1;
  for (int leg = 0; leg < 2; leg++) {
    const BeamJob* beam = job.beam[leg];
    if (!beam) continue;
    const double *antenna = (leg ? job.receiver : job.transmitter) + pulse, *axes = beam->axes + pulse;
    for (int slot = 0; slot < kPixels; slot++) {
      const double wx = at.x[slot] - antenna[0], wy = at.y[slot] - antenna[n], wz = at.z[slot] - antenna[2 * n];
      float v[3];
      for (int axis = 0; axis < 3; axis++)
        v[axis] = float(wx * axes[3 * axis * n] + wy * axes[(3 * axis + 1) * n] + wz * axes[(3 * axis + 2) * n]);
      weight[slot] *= look_up(*beam, 0, sample(*beam, 0, angle(v[1], v[0])));
      weight[slot] *= look_up(*beam, 1, sample(*beam, 1, angle(v[2], __builtin_sqrtf(v[0] * v[0] + v[1] * v[1]))));
    }
  }
}

// Sorts eight pulses into forms.
template <bool kTerrain>
inline void sort_weighted(const ApertureJob& job, const Patch& patch, int64_t pulse, int pulses, Batch& batch) {
  Aim aim;
  Sight sight[kBatch];
  weigh(job, patch, pulse, batch, sight);
  bool lit = false;
  for (int q = 0; q < pulses; q++) lit |= sight[q] != kDark;
  if (lit) aim_at<kTerrain>(job, patch, pulse, aim);
  for (int form = 0; form < kForms; form++) batch.count[form] = 0;
  for (int q = 0; q < pulses; q++) {
    Form form = kExact;
    if (sight[q] == kDark)
      form = kSkip;
    else if (sight[q] == kSmooth && aim.holds[q])
      form = place<kTerrain, true>(job, patch, aim, pulse, q, batch);
    if (form == kOwn) form = kWeighted;
    batch.order[form][batch.count[form]++] = q;
  }
}

}  // namespace
