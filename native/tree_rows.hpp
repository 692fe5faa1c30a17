// Pulses that are not replaced by virtual pulses: expanded to cells once for all tiles. docs/theory/tree.md, "Leaves".
#pragma once
#include "tree_leaf.hpp"

namespace {

constexpr int64_t kRows = 16;  // pulses expanded at once, so that the second-level cache holds them and a tile

// Pulses expanded to cells: cell 0 of a row is at sample `first` of its pulse.
struct Rows {
  int64_t first[kRows], samples = 0;
  Floats held, cells, gain, cosines, sines;
  int64_t low = 0, high = 0;  // sample range of the carrier from sample 0, which is independent of tiles
};

// Computes the carrier exp(j k r), with r from sample 0 of a profile, at the samples of all rows.
inline void carry(const TreeJob& job, int64_t count, Rows& rows) {
  constexpr int64_t kMore = 64;  // additional samples for the following pulses
  const int64_t low = *std::min_element(rows.first, rows.first + count);
  const int64_t high = *std::max_element(rows.first, rows.first + count) + rows.samples;
  if (rows.low <= low && high <= rows.high) return;
  rows.low = low - kMore, rows.high = high + kMore;
  put_carrier(job, 0, rows.low * job.up, (rows.high - rows.low) * job.up, rows.cosines, rows.sines);
}

// Determines the sample range of each pulse that the tiles need.
inline void take_samples(const TreeJob& job, const std::vector<TileState*>& tiles, int64_t begin, int64_t count,
                         Rows& rows) {
  rows.samples = 0;
  for (int64_t p = 0; p < count; p++) {
    int64_t first = INT64_MAX, last = INT64_MIN;
    for (const TileState* state : tiles) {
      const double centre = legs_of(job, state->tile.centre, begin + p).range + state->tile.first_path;
      const int64_t at = int64_t(std::floor((centre - job.start[begin + p]) / job.step));
      first = std::min(first, at), last = std::max(last, at + state->tile.samples + 1);
    }
    rows.first[p] = first, rows.samples = std::max(rows.samples, last - first);
  }
}

inline void expand_row(const TreeJob& job, int64_t pulse, int64_t row, Rows& rows) {
  const int64_t count = rows.samples + job.taps_count, before = rows.first[row] + job.lead;
  const double turn = std::fmod(job.wavenumber * job.start[pulse], 6.283185307179586);
  const float c = float(std::cos(turn)), s = float(std::sin(turn));
  float* held = rows.held.data();
  const float* samples = job.samples + 2 * pulse * job.length;
  const int64_t low = std::min(count, std::max<int64_t>(0, -before));  // zeros beyond the profile
  const int64_t high = std::max(low, std::min(count, job.length - before));
  std::fill(held, held + 2 * low, 0.0f), std::fill(held + 2 * high, held + 2 * count, 0.0f);
  for (int64_t n = low; n < high; n++) {
    const float re = samples[2 * (before + n)], im = samples[2 * (before + n) + 1];
    held[2 * n] = re * c - im * s, held[2 * n + 1] = re * s + im * c;
  }
  const int64_t carrier = kRecord * (rows.first[row] - rows.low) * job.up;
  expand(job, held, rows.samples, &rows.cosines[carrier], &rows.sines[carrier],
         &rows.cells[kRecord * row * rows.samples * job.up]);
}

// Adds pulses begin … end one by one to the leaves of the given tiles.
template <class Phase>
inline void sum_each(const TreeJob& job, const std::vector<TileState*>& tiles, int64_t begin, int64_t end, Rows& rows) {
  for (int64_t first = begin; first < end; first += kRows) {
    const int64_t count = std::min(kRows, end - first);
    take_samples(job, tiles, first, count, rows);
    const int64_t width = rows.samples * job.up;
    carry(job, count, rows);
    rows.cells.resize(size_t(kRecord * width * kRows)), rows.held.resize(size_t(2 * (rows.samples + job.taps_count)));
    for (int64_t p = 0; p < count; p++) expand_row(job, first + p, p, rows);
    for (TileState* state : tiles)
      for (int64_t p = 0; p < count; p++) {
        const int64_t pulse = first + p;
        const TreeTile& tile = state->tile;
        const bool edge = tile.edge[pulse / kTreeGroup];
        const Look look = edge ? look_of(job, tile.centre, pulse) : Look{legs_of(job, tile.centre, pulse)};
        const double place = (look.legs.range - job.start[pulse]) * double(job.up) / job.step;
        const Cells cells(&rows.cells[kRecord * p * width], rows.first[p] * job.up, width, place);
        const float* weight = tile.weight ? tile.weight + pulse * kTreeWeights : nullptr;
        const float* gain = node_gains(job, *state->leaf, look, edge, weight, rows.gain);
        if (job.mono)
          add_pulse<Phase, true>(job, *state->leaf, look.legs, gain, cells, state->re.data(), state->im.data());
        else
          add_pulse<Phase, false>(job, *state->leaf, look.legs, gain, cells, state->re.data(), state->im.data());
      }
  }
}

}  // namespace
