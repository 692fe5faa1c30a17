// How pulses see a tile: paths to a few places of it, and their slopes. docs/theory/tree.md, "Support".
#pragma once
#include <algorithm>
#include <cmath>

#include "tree_tile.hpp"

namespace {

constexpr int64_t kSeen = 16;  // places at which a tile is looked at: 4 x 4, corners included

// Places of a tile and how they move with xi and eta: over the tile, and along its two axes (4 on each; the rest
// repeats them). Plain arrays of kSeen, which the compiler makes vectors of.
struct Seen {
  alignas(64) float at[4][kSeen], by_xi[3][kSeen], by_eta[3][kSeen];
  alignas(64) float axis_at[4][kSeen], by_axis[3][kSeen];
  double radius;  // of the tile
  double bend;    // square of half the distance between neighbours: how far the path may dip between them, times 1/R
};

inline void put_place(const TreeTile& tile, const double* along_xi, const double* along_eta, float (*at)[kSeen],
                      int64_t n) {
  double offset[3];
  offset_at(tile, along_xi, along_eta, offset);
  at[3][n] = 0;
  for (int64_t axis = 0; axis < 3; axis++) at[axis][n] = float(offset[axis]), at[3][n] += at[axis][n] * at[axis][n];
}

inline void put_slope(const TreeTile& tile, const double* along_xi, const double* along_eta, float (*by)[kSeen],
                      int64_t n) {
  double slope[3];
  offset_at(tile, along_xi, along_eta, slope);
  for (int64_t axis = 0; axis < 3; axis++) by[axis][n] = float(slope[axis] + tile.centre[axis]);
}

inline Seen seen_of(const TreeTile& tile) {
  Seen seen;
  double value[5][kTreeDegree + 2], slope[5][kTreeDegree + 2];
  const double place[5] = {-1, -1. / 3, 1. / 3, 1, 0};
  for (int64_t n = 0; n < 5; n++) legendre(place[n], tile.degree, value[n], slope[n]);
  for (int64_t n = 0; n < kSeen; n++) {
    const int64_t x = n % 4, y = n / 4;
    put_place(tile, value[x], value[y], seen.at, n);
    put_slope(tile, slope[x], value[y], seen.by_xi, n), put_slope(tile, value[x], slope[y], seen.by_eta, n);
    // Lanes 0 … 3 lie along xi, 4 … 7 along eta.
    const bool xi = n % 8 < 4;
    put_place(tile, xi ? value[x] : value[4], xi ? value[4] : value[x], seen.axis_at, n);
    put_slope(tile, xi ? slope[x] : value[4], xi ? value[4] : slope[x], seen.by_axis, n);
  }
  double xi2 = 0, eta2 = 0;
  for (int64_t axis = 0; axis < 3; axis++)
    xi2 += seen.by_xi[axis][5] * seen.by_xi[axis][5], eta2 += seen.by_eta[axis][5] * seen.by_eta[axis][5];
  seen.bend = (xi2 + eta2) / 9, seen.radius = std::sqrt(xi2 + eta2);
  return seen;
}

// Derivatives of the path along xi and eta over the tile, and along its axes, metres per half tile.
struct Slopes {
  alignas(64) float xi[kSeen], eta[kSeen], axis[kSeen];
};

inline void add_slopes(const float* w, float square, const Seen& seen, Slopes& out) {
  for (int64_t n = 0; n < kSeen; n++) {
    const float x = seen.at[0][n], y = seen.at[1][n], z = seen.at[2][n];
    const float inverse = 1 / __builtin_sqrtf(seen.at[3][n] + square + x * w[0] + y * w[1] + z * w[2]);
    const float a = (x + .5f * w[0]) * inverse, b = (y + .5f * w[1]) * inverse, c = (z + .5f * w[2]) * inverse;
    out.xi[n] += a * seen.by_xi[0][n] + b * seen.by_xi[1][n] + c * seen.by_xi[2][n];
    out.eta[n] += a * seen.by_eta[0][n] + b * seen.by_eta[1][n] + c * seen.by_eta[2][n];
  }
  for (int64_t n = 0; n < kSeen; n++) {
    const float x = seen.axis_at[0][n], y = seen.axis_at[1][n], z = seen.axis_at[2][n];
    const float inverse = 1 / __builtin_sqrtf(seen.axis_at[3][n] + square + x * w[0] + y * w[1] + z * w[2]);
    out.axis[n] += inverse * ((x + .5f * w[0]) * seen.by_axis[0][n] + (y + .5f * w[1]) * seen.by_axis[1][n] +
                              (z + .5f * w[2]) * seen.by_axis[2][n]);
  }
}

inline Slopes slopes_at(const Legs& legs, const Seen& seen) {
  Slopes out{};
  add_slopes(legs.transmitter, legs.squares[0], seen, out), add_slopes(legs.receiver, legs.squares[1], seen, out);
  return out;
}

// Paths of one pulse to the places of a tile, more than to its centre.
struct Reach {
  alignas(64) float further[kSeen];
  double low, high;  // of any place, on top of the centre's
};

inline Reach reach_of(const Legs& legs, const Seen& seen) {
  Reach out;
  for (int64_t n = 0; n < kSeen; n += kLanes)
    store(out.further + n,
          path(legs, load(seen.at[0] + n), load(seen.at[1] + n), load(seen.at[2] + n), load(seen.at[3] + n)));
  float least = 0, most = 0;
  for (const float r : out.further) least = r >= least ? least : r, most = r <= most ? most : r;  // no number stays
  // Paths are convex over a plane: none is longer than at a corner, and none much shorter than at the nearest place.
  const double dip = 0.5 * seen.bend * (1 / legs.ranges[0] + 1 / legs.ranges[1]);
  out.low = least - dip - 1e-3, out.high = most + 1e-3;
  return out;
}

}  // namespace
