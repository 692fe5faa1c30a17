// Merging of subapertures, and formation of the pixels: two small matrix products each. docs/theory/tree.md, "Merge".
#pragma once
#include "tree_tile.hpp"

namespace {

constexpr int64_t kPairs = kLanes / 2;           // complex numbers per vector
constexpr int64_t kWide = kLanes == 16 ? 4 : 2;  // vectors per row of a product block, limited by the registers
constexpr int64_t kTall = 4;                     // rows of a product block

inline int64_t pair_stride(int64_t count) { return padded(count, 8); }

struct MergeScratch {
  Floats half;  // after the product along xi
  Turns along_xi, along_eta;
};

// (5) along xi: kRows rows of pairs times duplicated weights, then multiplied by the phase factor of each column.
template <int64_t kRows, int64_t kVectors>
inline void mix_xi(const float* pairs, int64_t stride, const float* weight, int64_t wide, int64_t terms,
                   const Turns& turns, int64_t column, float* out) {
  Lanes sum[kRows][kVectors] = {};
  for (int64_t k = 0; k < terms; k++) {
    Lanes w[kVectors];
    for (int64_t v = 0; v < kVectors; v++) w[v] = load(weight + k * wide + column + v * kLanes);
    for (int64_t r = 0; r < kRows; r++) {
      const Lanes a = splat_pair(pairs + r * stride + 2 * k);
      for (int64_t v = 0; v < kVectors; v++) sum[r][v] += a * w[v];
    }
  }
  for (int64_t v = 0; v < kVectors; v++) {
    const Lanes c = load(&turns.cosines[column + v * kLanes]), s = load(&turns.sines[column + v * kLanes]);
    for (int64_t r = 0; r < kRows; r++) store(out + r * wide + column + v * kLanes, turned(sum[r][v], c, s));
  }
}

// (5) along eta: weights times rows of pairs, multiplied by the phase factor of each row, and added.
template <int64_t kRows, int64_t kVectors>
inline void mix_eta(const float* weight, int64_t terms, const float* pairs, int64_t wide, const Turns& turns,
                    int64_t row, int64_t column, float* out) {
  Lanes sum[kRows][kVectors] = {};
  for (int64_t k = 0; k < terms; k++) {
    Lanes p[kVectors];
    for (int64_t v = 0; v < kVectors; v++) p[v] = load(pairs + k * wide + column + v * kLanes);
    for (int64_t r = 0; r < kRows; r++) {
      const float a = weight[(row + r) * terms + k];
      for (int64_t v = 0; v < kVectors; v++) sum[r][v] += a * p[v];
    }
  }
  for (int64_t r = 0; r < kRows; r++) {
    const Lanes c = splat(turns.cosines[2 * (row + r)]), s = splat_pair(&turns.sines[2 * (row + r)]);
    for (int64_t v = 0; v < kVectors; v++) {
      float* at = out + r * wide + column + v * kLanes;
      store(at, load(at) + turned(sum[r][v], c, s));
    }
  }
}

// (8): product of weights and lines.
template <int64_t kRows, int64_t kVectors>
inline void mix_lines(const float* weight, int64_t terms, const float* lines, int64_t wide, int64_t row, int64_t column,
                      float* out) {
  Lanes sum[kRows][kVectors] = {};
  for (int64_t k = 0; k < terms; k++) {
    Lanes p[kVectors];
    for (int64_t v = 0; v < kVectors; v++) p[v] = load(lines + k * wide + column + v * kLanes);
    for (int64_t r = 0; r < kRows; r++) {
      const float a = weight[(row + r) * terms + k];
      for (int64_t v = 0; v < kVectors; v++) sum[r][v] += a * p[v];
    }
  }
  for (int64_t r = 0; r < kRows; r++)
    for (int64_t v = 0; v < kVectors; v++) store(out + r * wide + column + v * kLanes, sum[r][v]);
}

template <int64_t kCount>
struct Size {
  static constexpr int64_t value = kCount;
};

// Calls `body` for all rows, in groups whose size is a compile-time constant.
template <class Body>
inline void in_rows(int64_t rows, const Body& body) {
  int64_t r = 0;
  for (; r + kTall <= rows; r += kTall) body(Size<kTall>(), r);
  if (rows - r == 3) body(Size<3>(), r);
  if (rows - r == 2) body(Size<2>(), r);
  if (rows - r == 1) body(Size<1>(), r);
}

// Calls `body` for `wide` floats of columns, in groups of vectors whose size is a compile-time constant.
template <class Body>
inline void in_columns(int64_t wide, const Body& body) {
  for (int64_t column = 0; column < wide;) {
    const int64_t left = (wide - column) / kLanes;
    if constexpr (kWide == 4) {
      if (left == 3 || left == 5) {
        body(Size<3>(), column), column += 3 * kLanes;
        continue;
      }
      if (left >= 4) {
        body(Size<4>(), column), column += 4 * kLanes;
        continue;
      }
    }
    if (left >= 2)
      body(Size<2>(), column), column += 2 * kLanes;
    else
      body(Size<1>(), column), column += kLanes;
  }
}

// Nodes of a subaperture: numbers along each axis, and values as rows of pairs.
struct Nodes {
  int64_t columns, rows;
  const float* pairs;
};

// Product along xi for all rows of nodes and the columns of one strip.
template <int64_t kVectors>
inline void mix_strip(const TreeJob& job, const Nodes& from, int64_t slot, int64_t wide, int64_t column,
                      MergeScratch& work) {
  const float* weight = job.spread[from.columns * kTreeSlots + slot];
  const int64_t stride = 2 * pair_stride(from.columns);
  in_rows(from.rows, [&](auto rows, int64_t r) {
    mix_xi<decltype(rows)::value, kVectors>(from.pairs + r * stride, stride, weight, wide, from.columns, work.along_xi,
                                            column, &work.half[r * wide]);
  });
}

// (5): adds a subaperture to its parent.
inline void merge(const TreeJob& job, TileState& state, const Nodes& from, int64_t child, int64_t parent,
                  int64_t columns, int64_t rows, float* sum, MergeScratch& work) {
  const Legs legs = legs_of(job, state.tile.centre, child), above = legs_of(job, state.tile.centre, parent);
  axis_turns(job, line_of(job, state, columns, true), legs, &above, work.along_xi);
  axis_turns(job, line_of(job, state, rows, false), legs, &above, work.along_eta);
  const int64_t wide = 2 * pair_stride(columns);
  const float* weight = job.mix[from.rows * kTreeSlots + rows];
  work.half.resize(size_t(from.rows * wide));
  in_columns(wide, [&](auto vectors, int64_t column) {
    constexpr int64_t kVectors = decltype(vectors)::value;
    mix_strip<kVectors>(job, from, columns, wide, column, work);
    in_rows(rows, [&](auto tall, int64_t r) {
      mix_eta<decltype(tall)::value, kVectors>(weight, from.rows, work.half.data(), wide, work.along_eta, r, column,
                                               sum + r * wide);
    });
  });
}

constexpr int64_t kStrip = 16;  // rows of pixels per strip; strips are formed sequentially

// Restores the mixed part m of (3) at the pixels of a row, and adds `pairs` to the image.
inline void add_row(const TreeJob& job, const TileState& state, const Legs& shared, const float* along_xi,
                    float along_eta, int64_t row, const float* pairs) {
  const TreeTile& tile = state.tile;
  const double* pixels = tile.pixels + 3 * row * job.stride;
  float* image = tile.image + 2 * row * job.stride;
  alignas(64) float at[3][apertura::kTreeSide], value[2 * apertura::kTreeSide];
  const int64_t columns = tile.columns;
  for (int64_t n = 0; n < columns; n++)
    for (int64_t axis = 0; axis < 3; axis++) at[axis][n] = float(pixels[3 * n + axis] - tile.centre[axis]);
  for (int64_t axis = 0; axis < 3; axis++)
    for (int64_t n = columns; n % kLanes; n++) at[axis][n] = 0;
  const float turns_per_metre = float(job.wavenumber / 6.283185307179586);
  for (int64_t n = 0; n < columns; n += kLanes) {
    const Lanes x = load(at[0] + n), y = load(at[1] + n), z = load(at[2] + n);
    const Lanes mixed = path(shared, x, y, z, x * x + y * y + z * z) - load(along_xi + n) - along_eta;
    alignas(64) float cosines[2 * kLanes], sines[2 * kLanes];
    Lanes c, s;
    turn(mixed * turns_per_metre, c, s);
    store_pairs(cosines, c, c), store_pairs(sines, -s, s);
    for (int64_t part = 0; part < 2 * kLanes; part += kLanes)
      store(value + 2 * n + part, turned(load(pairs + 2 * n + part), load(cosines + part), load(sines + part)));
  }
  for (int64_t n = 0; n < 2 * columns; n++) image[n] += value[n];
}

// Last step: interpolation from nodes to pixels.
inline void form_pixels(const TreeJob& job, TileState& state, const Nodes& from, int64_t child, MergeScratch& work) {
  const TreeTile& tile = state.tile;
  const Points &x = line_of(job, state, tile.column_slot, true), &y = line_of(job, state, tile.row_slot, false);
  const Legs legs = legs_of(job, tile.centre, child), shared = shared_legs(job, tile);
  axis_turns(job, x, legs, nullptr, work.along_xi), axis_turns(job, y, legs, nullptr, work.along_eta);
  const int64_t wide = 2 * pair_stride(tile.columns);
  Floats along_xi(x.count), along_eta(y.count), strip(size_t(kStrip * wide + 2 * kLanes));
  for (int64_t n = 0; n < x.count; n += kLanes) store(&along_xi[n], path(shared, x, n));
  for (int64_t n = 0; n < y.count; n += kLanes) store(&along_eta[n], path(shared, y, n));
  work.half.resize(size_t(from.rows * wide));
  in_columns(wide, [&](auto vectors, int64_t column) {
    mix_strip<decltype(vectors)::value>(job, from, tile.column_slot, wide, column, work);
  });
  const float* weight = job.mix[from.rows * kTreeSlots + tile.row_slot];
  for (int64_t top = 0; top < tile.rows; top += kStrip) {
    const int64_t rows = tile.rows - top < kStrip ? tile.rows - top : kStrip;
    strip.assign(strip.size(), 0.0f);
    in_columns(wide, [&](auto vectors, int64_t column) {
      in_rows(rows, [&](auto tall, int64_t r) {
        mix_eta<decltype(tall)::value, decltype(vectors)::value>(weight, from.rows, work.half.data(), wide,
                                                                 work.along_eta, top + r, column, &strip[r * wide]);
      });
    });
    for (int64_t r = 0; r < rows; r++)
      add_row(job, state, shared, along_xi.data(), along_eta[top + r], top + r, &strip[r * wide]);
  }
}

}  // namespace
