// State of a tile in a tree: its surface at nodes and pixels. docs/theory/tree.md, "Surface" and "References".
#pragma once
#include <memory>
#include <vector>

#include "centre.hpp"
#include "tree_paths.hpp"

namespace {

using apertura::kTreeDegree;
using apertura::kTreeSlots;

// Legendre polynomials of degree 0 … degree at x, and their derivatives.
inline void legendre(double x, int64_t degree, double* value, double* slope = nullptr) {
  value[0] = 1, value[1] = x;
  for (int64_t n = 2; n <= degree; n++) value[n] = ((2 * n - 1) * x * value[n - 1] - (n - 1) * value[n - 2]) / n;
  if (!slope) return;
  slope[0] = 0, slope[1] = 1;
  for (int64_t n = 2; n <= degree; n++) slope[n] = slope[n - 2] + (2 * n - 1) * value[n - 1];
}

// Nodes of a leaf: positions, and phase factors of the mixed part m of (3).
struct LeafNodes {
  int64_t columns, rows, count;
  Points at;
  Floats cosine, sine;  // of -k m
  Floats xi, eta;       // positions in the tile, for antenna weights
  Floats centre;        // centre of the sector; empty if it is constant
};

struct TileState {
  const TreeTile& tile;
  std::unique_ptr<Points> lines[2][kTreeSlots];  // along xi through eta = 0, and along eta through xi = 0
  std::vector<std::unique_ptr<LeafNodes>> leaves;
  std::vector<Floats> sums;  // of the current subaperture at each level
  Floats cosines, sines;     // carrier at the cells of the tile
  Floats re, im;             // sums at the nodes of the current leaf
  const LeafNodes* leaf = nullptr;
  explicit TileState(const TreeTile& tile) : tile(tile), sums(apertura::kTreeLevels) {}
};

// Offset of the point (xi, eta) from the centre, from the polynomials' values at xi and eta.
inline void offset_at(const TreeTile& tile, const double* along_xi, const double* along_eta, double* offset) {
  const int64_t m = tile.degree + 1;
  for (int64_t axis = 0; axis < 3; axis++) offset[axis] = -tile.centre[axis];
  for (int64_t a = 0; a < m; a++)
    for (int64_t e = 0; e < m; e++)
      for (int64_t axis = 0; axis < 3; axis++)
        offset[axis] += along_eta[a] * along_xi[e] * tile.surface[(a * m + e) * 3 + axis];
}

// Mean square of the distances of all pixels from the surface; NaN if a pixel has non-finite coordinates.
inline double rest_of(const TreeJob& job, const TreeTile& tile) {
  const int64_t m = tile.degree + 1;
  std::vector<double> basis(size_t(m * tile.columns));
  double value[kTreeDegree + 2], total = 0;
  for (int64_t n = 0; n < tile.columns; n++) {
    legendre(tile.columns > 1 ? 2.0 * double(n) / double(tile.columns - 1) - 1 : 0, tile.degree, value);
    for (int64_t e = 0; e < m; e++) basis[e * tile.columns + n] = value[e];
  }
  for (int64_t row = 0; row < tile.rows; row++) {
    double line[(kTreeDegree + 1) * 3] = {}, sum = 0;
    legendre(tile.rows > 1 ? 2.0 * double(row) / double(tile.rows - 1) - 1 : 0, tile.degree, value);
    for (int64_t a = 0; a < m; a++)
      for (int64_t e = 0; e < 3 * m; e++) line[e] += value[a] * tile.surface[a * 3 * m + e];
    const double* pixels = tile.pixels + 3 * row * job.stride;
    alignas(64) double rest[apertura::kTreeSide];
    for (int64_t axis = 0; axis < 3; axis++) {
      for (int64_t n = 0; n < tile.columns; n++) rest[n] = pixels[3 * n + axis] - line[axis];
      for (int64_t e = 1; e < m; e++)
        for (int64_t n = 0; n < tile.columns; n++) rest[n] -= line[3 * e + axis] * basis[e * tile.columns + n];
      double part[8] = {};
      for (int64_t n = 0; n < tile.columns; n++) part[n % 8] += rest[n] * rest[n];
      for (const double one : part) sum += one;
    }
    total += sum;
  }
  return total / double(tile.rows * tile.columns);
}

inline int64_t points_of(const TileState& state, int64_t slot) {
  if (slot <= apertura::kTreeNodes) return slot;
  return slot == state.tile.column_slot ? state.tile.columns : state.tile.rows;
}

// Points of a tile's axis at the nodes or pixels of a slot.
inline const Points& line_of(const TreeJob& job, TileState& state, int64_t slot, bool along_xi) {
  std::unique_ptr<Points>& line = state.lines[along_xi ? 0 : 1][slot];
  if (line) return *line;
  line.reset(new Points);
  const int64_t count = points_of(state, slot);
  double zero[kTreeDegree + 2], here[kTreeDegree + 2], offset[3];
  legendre(0, state.tile.degree, zero);
  line->resize(count);
  for (int64_t n = 0; n < count; n++) {
    legendre(job.places[slot][n], state.tile.degree, here);
    offset_at(state.tile, along_xi ? here : zero, along_xi ? zero : here, offset);
    line->put(n, offset);
  }
  line->fill(count);
  return *line;
}

// Pulse whose mixed part m of (3) is common to all subapertures of a chunk.
inline Legs shared_legs(const TreeJob& job, const TreeTile& tile) { return legs_of(job, tile.centre, job.pulses / 2); }

inline void put_mixed_turns(const TreeJob& job, TileState& state, LeafNodes& leaf) {
  const Legs shared = shared_legs(job, state.tile);
  const Points &x = line_of(job, state, leaf.columns, true), &y = line_of(job, state, leaf.rows, false);
  Floats along_x(x.count), along_y(y.count), mixed(leaf.at.count, 0.0f);
  for (int64_t n = 0; n < x.count; n += kLanes) store(&along_x[n], path(shared, x, n));
  for (int64_t n = 0; n < y.count; n += kLanes) store(&along_y[n], path(shared, y, n));
  for (int64_t n = 0; n < leaf.count; n++) mixed[n] = along_x[n % leaf.columns] + along_y[n / leaf.columns];
  const float turns_per_metre = float(-job.wavenumber / 6.283185307179586);
  leaf.cosine.assign(leaf.at.count + kLanes, 0.0f), leaf.sine = leaf.cosine;
  for (int64_t n = 0; n < leaf.at.count; n += kLanes) {
    Lanes c, s;
    turn((path(shared, leaf.at, n) - load(&mixed[n])) * turns_per_metre, c, s);
    store(&leaf.cosine[n], c), store(&leaf.sine[n], s);
  }
}

inline const LeafNodes& leaf_of(const TreeJob& job, TileState& state, int64_t columns, int64_t rows) {
  for (const auto& leaf : state.leaves)
    if (leaf->columns == columns && leaf->rows == rows) return *leaf;
  state.leaves.emplace_back(new LeafNodes{columns, rows, columns * rows, {}, {}, {}, {}, {}, {}});
  LeafNodes& leaf = *state.leaves.back();
  const TreeTile& tile = state.tile;
  const int64_t m = tile.degree + 1;
  leaf.at.resize(leaf.count);
  leaf.xi.assign(leaf.at.count, 0.0f), leaf.eta = leaf.xi;
  const bool centred = job.sector && job.sector->ends;
  if (centred) leaf.centre.assign(leaf.at.count, float(job.sector->centre));
  std::vector<double> along_xi(size_t(columns) * (kTreeDegree + 2));
  for (int64_t n = 0; n < columns; n++) legendre(job.places[columns][n], tile.degree, &along_xi[n * (kTreeDegree + 2)]);
  for (int64_t row = 0; row < rows; row++) {
    double along_eta[kTreeDegree + 2], line[(kTreeDegree + 1) * 3] = {};
    legendre(job.places[rows][row], tile.degree, along_eta);
    for (int64_t a = 0; a < m; a++)
      for (int64_t e = 0; e < 3 * m; e++) line[e] += along_eta[a] * tile.surface[a * 3 * m + e];
    for (int64_t n = 0; n < columns; n++) {
      double offset[3];
      for (int64_t axis = 0; axis < 3; axis++) {
        offset[axis] = -tile.centre[axis];
        for (int64_t e = 0; e < m; e++) offset[axis] += along_xi[n * (kTreeDegree + 2) + e] * line[3 * e + axis];
      }
      leaf.at.put(row * columns + n, offset);
      if (centred) {
        const double at[3] = {tile.centre[0] + offset[0], tile.centre[1] + offset[1], tile.centre[2] + offset[2]};
        leaf.centre[row * columns + n] = float(centre_of(*job.sector, flown_past(*job.sector, at, 0)));
      }
      leaf.xi[row * columns + n] = float(job.places[columns][n]);
      leaf.eta[row * columns + n] = float(job.places[rows][row]);
    }
  }
  leaf.at.fill(leaf.count);
  put_mixed_turns(job, state, leaf);
  return leaf;
}

}  // namespace
