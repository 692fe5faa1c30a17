// Leaves of a tree: pulses presummed to fewer virtual pulses for one tile, and summed at its nodes. Numbers in brackets
// are equations of docs/theory/tree.md, "Leaves".
#pragma once
#include <algorithm>
#include <cmath>
#include <cstring>

#include "phase.hpp"
#include "tree_merge.hpp"
#include "tree_weight.hpp"

namespace {

using apertura::kTreeDelays;
using apertura::kTreeTerms;

constexpr int64_t kRecord = 4;                // floats of a cell: level and slope, re and im each
constexpr int64_t kCells = kLanes / kRecord;  // cells per vector

// Scratch memory of leaves. Lines are rows of pairs: samples of the pulses over one tile, aligned to its centre.
struct LeafScratch {
  Floats taken, lines, virtual_lines, cells, pairs, gain, along_xi[2], along_eta[2];
};

// Cells of a pulse over a tile: the cell at the path of its centre, the offset of the path from it, and their limits.
struct Cells {
  const float* middle;
  float offset, low, high;
  // `cells` contains `width` cells from number `first` on; `place` is the path of the centre, in cells from number 0.
  Cells(const float* cells, int64_t first, int64_t width, double place) {
    const double whole = std::floor(place);
    const int64_t number = int64_t(whole) - first;
    middle = cells + kRecord * number, offset = float(place - whole);
    low = float(-number), high = float(width - 1 - number);
  }
};

// Computes exp(j k r) at `width` cells from number `first` on, with number 0 at r = `from`, as factors for pairs.
inline void put_carrier(const TreeJob& job, double from, int64_t first, int64_t width, Floats& cosines, Floats& sines) {
  cosines.resize(size_t(kRecord * width)), sines.resize(size_t(kRecord * width));
  for (int64_t cell = 0; cell < width; cell++) {
    const double turn =
        std::fmod(job.wavenumber * (from + double(first + cell) * job.step / double(job.up)), 6.283185307179586);
    const float c = float(std::cos(turn)), s = float(std::sin(turn));
    for (int64_t n = 0; n < kRecord; n++) cosines[kRecord * cell + n] = c, sines[kRecord * cell + n] = n % 2 ? s : -s;
  }
}

// Pairs per line: the samples of a tile, and those around them within the filters of cells.
inline int64_t line_length(const TreeJob& job, const TreeTile& tile) {
  return padded(tile.samples + job.taps_count, 8);
}

// (7): resamples one pulse, with any fractional start, at the samples of a tile, and applies exp(j k |w|).
inline void align(const TreeJob& job, const TreeTile& tile, int64_t pulse, float* taken, float* line) {
  const Legs legs = legs_of(job, tile.centre, pulse);
  const int64_t length = line_length(job, tile), count = length + kTreeDelays;
  const double at = (legs.range + tile.first_path - job.start[pulse]) / job.step + double(job.lead),
               whole = std::floor(at);
  // Samples from `whole - kTreeDelays / 2 + 1` on, with zeros beyond the profile.
  const int64_t before = int64_t(whole) - kTreeDelays / 2 + 1;
  const int64_t low = std::min(count, std::max<int64_t>(0, -before));
  const int64_t high = std::max(low, std::min(count, job.length - before));
  std::fill(taken, taken + 2 * low, 0.0f), std::fill(taken + 2 * high, taken + 2 * count, 0.0f);
  std::memcpy(taken + 2 * low, job.samples + 2 * (pulse * job.length + before + low), size_t(8 * (high - low)));
  // Filter taps, which are polynomials of the fraction.
  alignas(64) float filter[kTreeDelays] = {};
  const float u = float(at - whole);
  for (int64_t term = job.delay_terms - 1; term >= 0; term--)
    for (int64_t tap = 0; tap < kTreeDelays; tap++) filter[tap] = filter[tap] * u + job.delay[term * kTreeDelays + tap];
  const double turn = std::fmod(job.wavenumber * legs.range, 6.283185307179586);
  const float c = float(std::cos(turn)), s = float(std::sin(turn)), both[2] = {-s, s};
  const Lanes cosine = splat(c), sine = splat_pair(both);
  for (int64_t n = 0; n < 2 * length; n += kLanes) {
    Lanes even{}, odd{};
    for (int64_t tap = 0; tap < kTreeDelays; tap += 2) {
      even += load(taken + n + 2 * tap) * filter[tap];
      odd += load(taken + n + 2 * tap + 2) * filter[tap + 1];
    }
    store(line + n, turned(even + odd, cosine, sine));
  }
}

// Expands `samples` samples of a line into cells: level and slope of the profile in each cell, by the filters of its
// position between samples, times a carrier.
inline void expand(const TreeJob& job, const float* line, int64_t samples, const float* cosines, const float* sines,
                   float* cells) {
  const int64_t along = job.up / kCells;  // vectors per sample
  for (int64_t sample = 0; sample < samples; sample++)
    for (int64_t v = 0; v < along; v++) {
      const float *from = line + 2 * sample, *tap = job.taps + v * kLanes;
      Lanes even{}, odd{};
      for (int64_t n = 0; n < job.taps_count; n += 2) {
        even += load(tap + n * kRecord * job.up) * splat_pair(from + 2 * n);
        odd += load(tap + (n + 1) * kRecord * job.up) * splat_pair(from + 2 * n + 2);
      }
      const int64_t at = kRecord * sample * job.up + v * kLanes;
      store(cells + at, turned(even + odd, load(cosines + at), load(sines + at)));
    }
}

// Adds one pulse at the nodes of a leaf: (2) of engine.md at the path of each node, times a gain.
template <class Phase, bool kMono>
inline void add_pulse(const TreeJob& job, const LeafNodes& leaf, const Legs& legs, const float* gain,
                      const Cells& cells, float* re, float* im) {
  const float scale = float(double(job.up) / job.step);
  const Lanes low = splat(cells.low), high = splat(cells.high);
  const float* x = leaf.at.x(0);
  const Phase phase(job.phase_coefficients);
  const int64_t count = leaf.at.count;
  for (int64_t n = 0; n < count; n += kLanes) {
    const Lanes extra_path =
        path<kMono>(legs, load(x + n), load(x + count + n), load(x + 2 * count + n), load(x + 3 * count + n));
    // Clamped to the row, so that no look-up is outside it.
    const Lanes t = smaller(larger(extra_path * scale + cells.offset, low), high), rounded = t + kRounder;
    const Lanes u = t - (rounded - kRounder);
    alignas(64) int32_t at[kLanes];
    *reinterpret_cast<IntLanes*>(at) = ((IntLanes)rounded - (IntLanes)splat(kRounder)) * int32_t(kRecord);
    asm volatile("" : "+m"(at));  // through memory, because extracting single lanes occupies the shuffle port
    Lanes fields[4], cosine, sine;
    load_records(cells.middle, at, fields);
    Lanes vr = fields[0] + u * fields[2], vi = fields[1] + u * fields[3];
    phase(u, cosine, sine);
    if (gain) vr *= load(gain + n), vi *= load(gain + n);
    store(re + n, load(re + n) + vr * cosine - vi * sine);
    store(im + n, load(im + n) + vr * sine + vi * cosine);
  }
}

// Computes exp(-j k R) along an axis, as planes of re and im.
inline void axis_planes(const TreeJob& job, const Points& line, const Legs& legs, Floats* out) {
  out[0].resize(size_t(line.count)), out[1].resize(size_t(line.count));
  for (int64_t n = 0; n < line.count; n += kLanes) {
    Lanes c, s;
    turn(path(legs, line, n) * float(-job.wavenumber / 6.283185307179586), c, s);
    store(&out[0][n], c), store(&out[1][n], s);
  }
}

// Removes the reference from the sums of a leaf, and stores them as pairs: rows along eta with a stride of `stride`.
inline void take_reference_off(const TreeJob& job, TileState& state, const LeafNodes& leaf, int64_t middle,
                               int64_t stride, LeafScratch& work) {
  const Legs legs = legs_of(job, state.tile.centre, middle);
  axis_planes(job, line_of(job, state, leaf.columns, true), legs, work.along_xi);
  axis_planes(job, line_of(job, state, leaf.rows, false), legs, work.along_eta);
  work.pairs.resize(size_t(2 * (stride * leaf.rows + 2 * kLanes)));
  for (int64_t row = 0; row < leaf.rows; row++) {
    const float yr = work.along_eta[0][row], yi = work.along_eta[1][row];
    for (int64_t n = 0; n < leaf.columns; n += kLanes) {  // lanes beyond the row's end are overwritten by the next row
      const int64_t at = row * leaf.columns + n;
      const Lanes xr = load(&work.along_xi[0][n]), xi = load(&work.along_xi[1][n]);
      const Lanes ar = xr * yr - xi * yi, ai = xr * yi + xi * yr;
      const Lanes mr = load(&leaf.cosine[at]), mi = load(&leaf.sine[at]);
      const Lanes br = ar * mr - ai * mi, bi = ar * mi + ai * mr, vr = load(&state.re[at]), vi = load(&state.im[at]);
      store_pairs(&work.pairs[2 * (row * stride + n)], br * vr - bi * vi, br * vi + bi * vr);
    }
  }
}

// Cubic interpolation between the pulses of a leaf at a fractional pulse number `place`.
struct Between {
  int64_t first;
  float share[4];
  explicit Between(double place) {
    first = std::min(std::max<int64_t>(0, int64_t(std::floor(place)) - 1), apertura::kTreeGroup - 4);
    for (int64_t n = 0; n < 4; n++) {
      double product = 1;
      for (int64_t m = 0; m < 4; m++)
        if (m != n) product *= (place - double(first + m)) / double(n - m);
      share[n] = float(product);
    }
  }
};

// Virtual pulse of a leaf: phase centres on a smooth curve through those of the leaf, and weights.
struct VirtualPulse {
  Look look;
  float weight[kTreeWeights];
};

// Virtual pulse n of `count`, on the curve of the highest degree that `count` virtual pulses support, which follows the
// track most closely.
inline VirtualPulse virtual_pulse(const TreeJob& job, const TreeTile& tile, int64_t begin, int64_t count, int64_t n) {
  VirtualPulse out{};
  // Phase centres of b_v of (8) from the polynomials of the leaf's track.
  const double *curve = job.curve[count] + n * kTreeTerms,
               *track = job.track + begin / apertura::kTreeGroup * 6 * kTreeTerms;
  const int64_t terms = std::min(kTreeTerms, count - apertura::kTreeVirtualMargin + 1);
  double antenna[2][3] = {};
  for (int64_t leg = 0; leg < 2; leg++, track += 3 * kTreeTerms)
    for (int64_t term = 0; term < terms; term++)
      for (int64_t axis = 0; axis < 3; axis++) antenna[leg][axis] += curve[term] * track[3 * term + axis];
  out.look.legs = legs_between(tile.centre, antenna[0], antenna[1]);
  const bool edge = tile.edge[begin / apertura::kTreeGroup];
  if (!tile.weight && !edge) return out;
  // Axes of the sector and polynomials of the antennas' gain, interpolated between the pulses next to v.
  const Between between(0.5 * double(apertura::kTreeGroup - 1) * (1 + job.places[count][n]));
  double axis[2][3] = {};
  for (int64_t leg = 0; edge && leg < 2; leg++)
    for (int64_t near = 0; near < 4; near++)
      for (int64_t i = 0; i < 3; i++)
        axis[leg][i] +=
            double(between.share[near]) * job.sector->axis[leg][i * job.pulses + begin + between.first + near];
  if (edge) put_axes(tile.centre, antenna[0], antenna[1], axis, out.look);
  for (int64_t near = 0; tile.weight && near < 4; near++)
    for (int64_t term = 0; term < kTreeWeights; term++)
      out.weight[term] += between.share[near] * tile.weight[(begin + between.first + near) * kTreeWeights + term];
  return out;
}

// (8): the lines b_v of the virtual pulses of a leaf, from the aligned lines a_p of its pulses.
inline const float* virtual_lines(const TreeJob& job, const TreeTile& tile, int64_t begin, int64_t count,
                                  LeafScratch& work) {
  const int64_t wide = 2 * line_length(job, tile), pulses = apertura::kTreeGroup;
  work.taken.resize(size_t(wide + 2 * kTreeDelays)), work.lines.resize(size_t(wide * pulses));
  work.virtual_lines.resize(size_t(wide * count));
  for (int64_t p = 0; p < pulses; p++) align(job, tile, begin + p, work.taken.data(), &work.lines[p * wide]);
  const float* weight = job.presum[count];
  in_columns(wide, [&](auto vectors, int64_t column) {
    in_rows(count, [&](auto tall, int64_t r) {
      mix_lines<decltype(tall)::value, decltype(vectors)::value>(weight, pulses, work.lines.data(), wide, r, column,
                                                                 &work.virtual_lines[r * wide]);
    });
  });
  return work.virtual_lines.data();
}

// Sums a leaf at its nodes by its virtual pulses.
template <class Phase, bool kMono>
inline void sum_virtual_pulses(const TreeJob& job, TileState& state, const LeafNodes& leaf, int64_t begin,
                               LeafScratch& work) {
  const TreeTile& tile = state.tile;
  const int64_t count = tile.n_virtual_pulses[begin / apertura::kTreeGroup], wide = 2 * line_length(job, tile);
  const int64_t width = tile.samples * job.up;
  if (state.cosines.empty()) put_carrier(job, tile.first_path, 0, width, state.cosines, state.sines);
  const float* lines = virtual_lines(job, tile, begin, count, work);
  work.cells.resize(size_t(kRecord * width));
  const Cells cells(work.cells.data(), 0, width, -tile.first_path * double(job.up) / job.step);
  for (int64_t n = 0; n < count; n++) {
    const VirtualPulse pulse = virtual_pulse(job, tile, begin, count, n);
    expand(job, lines + n * wide, tile.samples, state.cosines.data(), state.sines.data(), work.cells.data());
    const float* gain = node_gains(job, leaf, pulse.look, tile.edge[begin / apertura::kTreeGroup],
                                   tile.weight ? pulse.weight : nullptr, work.gain);
    add_pulse<Phase, kMono>(job, leaf, pulse.look.legs, gain, cells, state.re.data(), state.im.data());
  }
}

}  // namespace
