// The leaves of a tree: pulses expanded to cells, and summed at the nodes of a tile. docs/theory/tree.md, "Leaves".
#pragma once
#include <algorithm>
#include <cmath>

#include "phase.hpp"
#include "tree_tile.hpp"

namespace {

using apertura::kTreeMargin;
using apertura::kTreeWeights;

constexpr int64_t kRecord = 4;                 // floats of a cell: level and slope, re and im each
constexpr int64_t kCells = kLanes / kRecord;   // that a vector holds

// Some pulses as cells: cell 0 of a row lies at sample `first` of its pulse.
struct Rows {
  int64_t begin, width;  // first pulse; cells
  Floats cells, padded, cosines, sines;
  float* row(int64_t pulse) { return cells.data() + (pulse - begin) * kRecord * width; }
};

// exp(j k cell), cell 0 at zero: the carrier is folded into the cells.
inline void fold_carrier(const TreeJob& job, Rows& rows) {
  rows.width = job.expanded * job.up;
  rows.cosines.resize(size_t(kRecord * rows.width)), rows.sines = rows.cosines;
  const double turn = std::fmod(job.wavenumber * job.step / double(job.up), 6.283185307179586);
  for (int64_t cell = 0; cell < rows.width; cell++) {
    const float c = float(std::cos(turn * double(cell))), s = float(std::sin(turn * double(cell)));
    for (int64_t n = 0; n < kRecord; n++)
      rows.cosines[kRecord * cell + n] = c, rows.sines[kRecord * cell + n] = n % 2 ? s : -s;
  }
}

// (1) of engine.md as pairs: level and slope of the profile in each cell, by the filters of its place between samples.
inline void expand_pulse(const TreeJob& job, int64_t pulse, Rows& rows) {
  const int64_t first = job.first[pulse], taps = apertura::kTaps;
  const double begin = job.start[pulse] + double(first) * job.step;
  const double turn = std::fmod(job.wavenumber * begin, 6.283185307179586);
  const float c = float(std::cos(turn)), s = float(std::sin(turn));
  float* held = rows.padded.data();
  const float* samples = job.samples + 2 * pulse * job.length;
  // Sample `first + lead` and on, zeros beyond the profile.
  const int64_t before = first + job.lead, count = job.expanded + taps;
  const int64_t low = std::max<int64_t>(0, -before), high = std::max(low, std::min(count, job.length - before));
  std::fill(held, held + 2 * low, 0.0f), std::fill(held + 2 * high, held + 2 * count, 0.0f);
  for (int64_t n = low; n < high; n++) {
    const float re = samples[2 * (before + n)], im = samples[2 * (before + n) + 1];
    held[2 * n] = re * c - im * s, held[2 * n + 1] = re * s + im * c;
  }
  float* row = rows.row(pulse);
  const int64_t along = job.up / kCells;  // vectors that the cells of one sample fill
  for (int64_t sample = 0; sample < job.expanded; sample++)
    for (int64_t v = 0; v < along; v++) {
      const float *from = held + 2 * sample, *tap = job.taps + v * kLanes;
      Lanes even{}, odd{};
      for (int64_t n = 0; n < taps; n += 2) {
        even += load(tap + n * kRecord * job.up) * splat_pair(from + 2 * n);
        odd += load(tap + (n + 1) * kRecord * job.up) * splat_pair(from + 2 * n + 2);
      }
      const int64_t at = kRecord * sample * job.up + v * kLanes;
      store(row + at, turned(even + odd, load(&rows.cosines[at]), load(&rows.sines[at])));
    }
}

// Gain of both antennas at a vector of nodes.
inline Lanes weight_at(const float* w, Lanes xi, Lanes eta) {
  Lanes along[4];
  for (int64_t b = 0; b < 4; b++) along[b] = w[4 * b] + xi * (w[4 * b + 1] + xi * (w[4 * b + 2] + xi * w[4 * b + 3]));
  return along[0] + eta * (along[1] + eta * (along[2] + eta * along[3]));
}

// Adds what one pulse has at the nodes of a leaf: (2) of engine.md at the path of each.
template <class Phase, bool kMono>
inline void add_pulse(const TreeJob& job, const TileState& state, const LeafNodes& leaf, int64_t pulse, Rows& rows,
                      float* re, float* im) {
  const Legs legs = legs_of(job, state.tile.centre, pulse);
  const double cells = double(job.up) / job.step;
  const double begin = job.start[pulse] + double(job.first[pulse]) * job.step;
  const double middle = (legs.range - begin) * cells, whole = std::floor(middle);
  const float offset = float(middle - whole), scale = float(cells);
  const int32_t centre = int32_t(whole);
  const Lanes low = splat(float(-whole)), high = splat(float(double(rows.width - 1) - whole));
  const float *base = rows.row(pulse), *x = leaf.at.x(0);
  const float* weight = state.tile.weight ? state.tile.weight + pulse * kTreeWeights : nullptr;
  const Phase phase(job.phase_coefficients);
  const int64_t count = leaf.at.count;
  for (int64_t n = 0; n < count; n += kLanes) {
    const Lanes further =
        path<kMono>(legs, load(x + n), load(x + count + n), load(x + 2 * count + n), load(x + 3 * count + n));
    // Held inside the row, whatever the path: no look-up leaves it.
    const Lanes t = smaller(larger(further * scale + offset, low), high), rounded = t + kRounder;
    const Lanes u = t - (rounded - kRounder);
    alignas(64) int32_t at[kLanes];
    *reinterpret_cast<IntLanes*>(at) = ((IntLanes)rounded - (IntLanes)splat(kRounder) + centre) * int32_t(kRecord);
    asm volatile("" : "+m"(at));  // through memory: taking lanes out one by one would keep the shuffle port
    Lanes fields[4], cosine, sine;
    load_records(base, at, fields);
    Lanes vr = fields[0] + u * fields[2], vi = fields[1] + u * fields[3];
    phase(u, cosine, sine);
    if (weight) {
      const Lanes gain = weight_at(weight, load(&leaf.xi[n]), load(&leaf.eta[n]));
      vr *= gain, vi *= gain;
    }
    store(re + n, load(re + n) + vr * cosine - vi * sine);
    store(im + n, load(im + n) + vr * sine + vi * cosine);
  }
}

// What leaves are computed in.
struct LeafScratch {
  Floats re, im, pairs, along_xi[2], along_eta[2];
};

// exp(-j k R) along an axis, as planes.
inline void axis_planes(const TreeJob& job, const Points& line, const Legs& legs, Floats* out) {
  out[0].resize(size_t(line.count)), out[1].resize(size_t(line.count));
  for (int64_t n = 0; n < line.count; n += kLanes) {
    Lanes c, s;
    turn(path(legs, line, n) * float(-job.wavenumber / 6.283185307179586), c, s);
    store(&out[0][n], c), store(&out[1][n], s);
  }
}

// Sums of a leaf, its reference taken off, as pairs: rows of eta, `stride` pairs apart.
inline void take_reference_off(const TreeJob& job, TileState& state, const LeafNodes& leaf, int64_t middle,
                               int64_t stride, LeafScratch& work) {
  const Legs legs = legs_of(job, state.tile.centre, middle);
  axis_planes(job, line_of(job, state, leaf.columns, true), legs, work.along_xi);
  axis_planes(job, line_of(job, state, leaf.rows, false), legs, work.along_eta);
  work.pairs.resize(size_t(2 * (stride * leaf.rows + 2 * kLanes)));
  for (int64_t row = 0; row < leaf.rows; row++) {
    const float yr = work.along_eta[0][row], yi = work.along_eta[1][row];
    for (int64_t n = 0; n < leaf.columns; n += kLanes) {  // beyond the row's end: overwritten by the next
      const int64_t at = row * leaf.columns + n;
      const Lanes xr = load(&work.along_xi[0][n]), xi = load(&work.along_xi[1][n]);
      const Lanes ar = xr * yr - xi * yi, ai = xr * yi + xi * yr;
      const Lanes mr = load(&leaf.cosine[at]), mi = load(&leaf.sine[at]);
      const Lanes br = ar * mr - ai * mi, bi = ar * mi + ai * mr, vr = load(&work.re[at]), vi = load(&work.im[at]);
      store_pairs(&work.pairs[2 * (row * stride + n)], br * vr - bi * vi, br * vi + bi * vr);
    }
  }
}

template <class Phase>
inline void sum_leaf(const TreeJob& job, TileState& state, const LeafNodes& leaf, int64_t begin, int64_t end,
                     Rows& rows, LeafScratch& work) {
  work.re.assign(size_t(leaf.at.count + kLanes), 0.0f), work.im = work.re;
  for (int64_t pulse = begin; pulse < end; pulse++)
    if (job.mono)
      add_pulse<Phase, true>(job, state, leaf, pulse, rows, work.re.data(), work.im.data());
    else
      add_pulse<Phase, false>(job, state, leaf, pulse, rows, work.re.data(), work.im.data());
}

}  // namespace
