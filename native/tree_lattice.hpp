// Geometry of one pulse over a tile, on a lattice of points: paths and their slopes. docs/theory/tree.md, "Support".
#pragma once
#include <algorithm>
#include <cmath>

#include "tree_tile.hpp"

namespace {

constexpr int64_t kLattice = 64;  // maximum points of the lattice: 8 x 8, including corners
constexpr int64_t kFew = 4;       // points along an axis if the band changes little between them; otherwise kMany
constexpr int64_t kMany = 8;
constexpr double kNearby = 0.5;  // largest ratio of a plane tile's half diagonal and the nearest range for kFew
constexpr int64_t kAxes = 2 * kMany;

// Points of a tile and their derivatives along xi and eta: over the tile, and along its two axes (`side` points on
// each, repeated in the remaining lanes). Plain arrays, which the compiler vectorises.
struct Lattice {
  alignas(64) float at[4][kLattice], by_xi[3][kLattice], by_eta[3][kLattice];
  alignas(64) float axis_at[4][kAxes], by_axis[3][kAxes];
  int64_t side, count;  // points along an axis, and in the tile
  double radius;        // of the tile
  double bend;          // square of half the point spacing; times 1/R, it bounds the dip of the path between points
  double relief;        // deviation of the surface from straight lines between points, metres of path
};

template <int64_t kPlaces>
inline void put_place(const TreeTile& tile, const double* along_xi, const double* along_eta, float (*at)[kPlaces],
                      int64_t n) {
  double offset[3];
  offset_at(tile, along_xi, along_eta, offset);
  at[3][n] = 0;
  for (int64_t axis = 0; axis < 3; axis++) at[axis][n] = float(offset[axis]), at[3][n] += at[axis][n] * at[axis][n];
}

template <int64_t kPlaces>
inline void put_slope(const TreeTile& tile, const double* along_xi, const double* along_eta, float (*by)[kPlaces],
                      int64_t n) {
  double slope[3];
  offset_at(tile, along_xi, along_eta, slope);
  for (int64_t axis = 0; axis < 3; axis++) by[axis][n] = float(slope[axis] + tile.centre[axis]);
}

// Largest negative second difference along xi or eta of values at `side` x `side` points.
inline float bent(const float* value, int64_t side, int64_t step) {
  float most = 0;
  for (int64_t n = 0; n < side * side; n++) {
    const int64_t along = n / step % side;
    if (along == 0 || along == side - 1) continue;
    most = std::max(most, 2 * value[n] - value[n - step] - value[n + step]);
  }
  return most;
}

// Deviation of the surface from straight lines between points, for both antennas: an eighth of its second differences.
inline double relief_of(const Lattice& lattice) {
  double square = 0;
  for (const auto& axis : {lattice.at[0], lattice.at[1], lattice.at[2]}) {
    float turned[kLattice];
    for (int64_t n = 0; n < lattice.count; n++) turned[n] = -axis[n];
    for (const int64_t step : {int64_t(1), lattice.side}) {
      const double most = std::max(bent(axis, lattice.side, step), bent(turned, lattice.side, step)) / 4;
      square += most * most;
    }
  }
  return std::sqrt(2 * square);
}

// Distance of a tile's centre from the nearest antenna at the first, middle and last pulse.
inline double nearest_of(const TreeJob& job, const TreeTile& tile) {
  double nearest = 1e300;
  for (const int64_t pulse : {int64_t(0), job.pulses / 2, job.pulses - 1}) {
    const Legs legs = legs_of(job, tile.centre, pulse);
    nearest = std::min({nearest, double(legs.ranges[0]), double(legs.ranges[1])});
  }
  return nearest;
}

inline Lattice lattice_of_side(const TreeTile& tile, int64_t side) {
  Lattice lattice;
  lattice.side = side, lattice.count = side * side;
  double value[kMany + 1][kTreeDegree + 2], slope[kMany + 1][kTreeDegree + 2];
  for (int64_t n = 0; n <= side; n++)
    legendre(n < side ? 2.0 * double(n) / double(side - 1) - 1 : 0, tile.degree, value[n], slope[n]);
  for (int64_t n = 0; n < lattice.count; n++) {
    const int64_t x = n % side, y = n / side;
    put_place(tile, value[x], value[y], lattice.at, n);
    put_slope(tile, slope[x], value[y], lattice.by_xi, n), put_slope(tile, value[x], slope[y], lattice.by_eta, n);
  }
  for (int64_t n = 0; n < kAxes; n++) {  // lanes 0 ... side - 1 are along xi, the next `side` lanes along eta
    const int64_t x = n % side;
    const bool xi = n / side % 2 == 0;
    put_place(tile, xi ? value[x] : value[side], xi ? value[side] : value[x], lattice.axis_at, n);
    put_slope(tile, xi ? slope[x] : value[side], xi ? value[side] : slope[x], lattice.by_axis, n);
  }
  double xi2 = 0, eta2 = 0;
  const int64_t middle = (side / 2 - 1) * (side + 1);
  for (int64_t axis = 0; axis < 3; axis++)
    xi2 += lattice.by_xi[axis][middle] * lattice.by_xi[axis][middle],
        eta2 += lattice.by_eta[axis][middle] * lattice.by_eta[axis][middle];
  lattice.bend = (xi2 + eta2) / double((side - 1) * (side - 1)), lattice.radius = std::sqrt(xi2 + eta2);
  lattice.relief = tile.degree > 1 ? relief_of(lattice) : 0;
  return lattice;
}

// 4 x 4 points suffice if the band changes slowly, so that second differences bound it between them; 8 x 8 are used for
// curved surfaces, and near an antenna, where the band may have a peak within the tile.
inline Lattice lattice_of(const TreeJob& job, const TreeTile& tile) {
  const Lattice lattice = lattice_of_side(tile, kFew);
  return tile.degree > 1 || lattice.radius > kNearby * nearest_of(job, tile) ? lattice_of_side(tile, kMany) : lattice;
}

// Derivatives of the path along xi and eta over the tile, and along its axes, metres per half tile.
struct Slopes {
  alignas(64) float xi[kLattice], eta[kLattice], axis[kAxes];
};

inline void add_slopes(const float* w, float square, const Lattice& lattice, Slopes& out) {
  for (int64_t n = 0; n < lattice.count; n++) {
    const float x = lattice.at[0][n], y = lattice.at[1][n], z = lattice.at[2][n];
    const float inverse = 1 / __builtin_sqrtf(lattice.at[3][n] + square + x * w[0] + y * w[1] + z * w[2]);
    const float a = (x + .5f * w[0]) * inverse, b = (y + .5f * w[1]) * inverse, c = (z + .5f * w[2]) * inverse;
    out.xi[n] += a * lattice.by_xi[0][n] + b * lattice.by_xi[1][n] + c * lattice.by_xi[2][n];
    out.eta[n] += a * lattice.by_eta[0][n] + b * lattice.by_eta[1][n] + c * lattice.by_eta[2][n];
  }
  for (int64_t n = 0; n < kAxes; n++) {
    const float x = lattice.axis_at[0][n], y = lattice.axis_at[1][n], z = lattice.axis_at[2][n];
    const float inverse = 1 / __builtin_sqrtf(lattice.axis_at[3][n] + square + x * w[0] + y * w[1] + z * w[2]);
    out.axis[n] += inverse * ((x + .5f * w[0]) * lattice.by_axis[0][n] + (y + .5f * w[1]) * lattice.by_axis[1][n] +
                              (z + .5f * w[2]) * lattice.by_axis[2][n]);
  }
}

inline Slopes slopes_at(const Legs& legs, const Lattice& lattice) {
  Slopes out{};
  add_slopes(legs.transmitter, legs.squares[0], lattice, out), add_slopes(legs.receiver, legs.squares[1], lattice, out);
  return out;
}

// Paths of one pulse to the points of a tile, minus the path to its centre.
struct Reach {
  alignas(64) float extra_path[kLattice];
  double low, high;  // bounds over the tile, relative to the centre
};

inline Reach reach_of(const Legs& legs, const Lattice& lattice) {
  Reach out;
  for (int64_t n = 0; n < lattice.count; n += kLanes)
    store(out.extra_path + n, path(legs, load(lattice.at[0] + n), load(lattice.at[1] + n), load(lattice.at[2] + n),
                                   load(lattice.at[3] + n)));
  float least = 0, most = 0;
  for (int64_t n = 0; n < lattice.count; n++) {
    const float r = out.extra_path[n];
    least = r >= least ? least : r, most = r <= most ? most : r;  // keeps a NaN
  }
  // Paths are convex over a plane: the longest is at a corner, and none is much shorter than at the nearest point.
  const double dip = 0.5 * lattice.bend * (1 / legs.ranges[0] + 1 / legs.ranges[1]);
  out.low = least - dip - lattice.relief - 1e-3, out.high = most + lattice.relief + 1e-3;
  return out;
}

}  // namespace
