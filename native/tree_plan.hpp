// How many nodes each subaperture of a tile needs, and which pulses its tree can take. docs/theory/tree.md, "Support".
#pragma once
#include <algorithm>
#include <cmath>

#include "tree_tile.hpp"

namespace {

using apertura::kDirectly;
using apertura::kSilently;
using apertura::kTreeGroup;
using apertura::kTreeNodes;

constexpr int64_t kSeen = 16;  // places at which a tile is looked at: 4 x 4, corners included

// Places of a tile and how they move with xi and eta: over the tile, and along its two axes (4 on each; the rest repeats
// them). Plain arrays of kSeen, which the compiler makes vectors of.
struct Seen {
  alignas(64) float at[4][kSeen], by_xi[3][kSeen], by_eta[3][kSeen];
  alignas(64) float axis_at[4][kSeen], by_axis[3][kSeen];
  double bend;  // square of half the distance between neighbours: how far the path may dip between them, times 1/R
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
  seen.bend = (xi2 + eta2) / 9;
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

// Shortest and longest path of one pulse over a tile.
inline void reach(const TreeJob& job, const TreeTile& tile, const Seen& seen, int64_t pulse, double* low, double* high) {
  const Legs legs = legs_of(job, tile.centre, pulse);
  float least = 0, most = 0;
  for (int64_t n = 0; n < kSeen; n += kLanes) {
    const Lanes r = path(legs, load(seen.at[0] + n), load(seen.at[1] + n), load(seen.at[2] + n), load(seen.at[3] + n));
    for (int64_t lane = 0; lane < kLanes; lane++)  // no number stays
      least = r[lane] >= least ? least : r[lane], most = r[lane] <= most ? most : r[lane];
  }
  // Paths are convex over a plane: none is longer than at a corner, and none much shorter than at the nearest place.
  const double dip = 0.5 * seen.bend * (1 / legs.ranges[0] + 1 / legs.ranges[1]) + 1e-3;
  *low = legs.range + least - dip, *high = legs.range + most + 1e-3;
}

// Marks groups of pulses whose profiles end inside the tile, or do not reach it, and notes what is to be expanded.
inline void mark_groups(const TreeJob& job, TreeTile& tile, const Seen& seen, std::vector<int64_t>& last) {
  const double margin = apertura::kTreeMargin + 8;  // samples: half the taps of a table see beyond a path
  for (int64_t begin = 0; begin < job.pulses; begin += kTreeGroup) {
    uint8_t& way = tile.way[begin / kTreeGroup];
    if (way != apertura::kByTree) continue;
    const int64_t count = std::min(kTreeGroup, job.pulses - begin);
    double low[kTreeGroup], high[kTreeGroup];
    bool inside = true, outside = true;
    for (int64_t q = 0; q < count; q++) {
      reach(job, tile, seen, begin + q, &low[q], &high[q]);
      low[q] = (low[q] - job.start[begin + q]) / job.step, high[q] = (high[q] - job.start[begin + q]) / job.step;
      inside &= low[q] >= margin && high[q] <= double(job.length) - 1 - margin;
      outside &= high[q] <= -margin || low[q] >= double(job.length) - 1 + margin;
    }
    way = inside ? apertura::kByTree : outside ? kSilently : kDirectly;
    for (int64_t q = 0; inside && q < count; q++) {
      job.first[begin + q] = std::min(job.first[begin + q], int64_t(std::floor(low[q])) - apertura::kTreeMargin);
      last[begin + q] = std::max(last[begin + q], int64_t(std::ceil(high[q])) + apertura::kTreeMargin);
    }
  }
}

// The least number of nodes that holds a band, rad per half tile; more than kTreeNodes where none does.
inline int64_t nodes_for(const TreeJob& job, double band) {
  if (!(band <= job.supports[kTreeNodes])) return kTreeNodes + 1;
  return std::max<int64_t>(2, std::lower_bound(job.supports, job.supports + kTreeNodes + 1, band) - job.supports);
}

// (4): the band left on a tile by one pulse against the reference of its subaperture.
struct Band {
  float xi[kSeen] = {}, eta[kSeen] = {};
  void include(const TreeJob& job, const Slopes& pulse, const Slopes& reference, const Slopes& mixed) {
    const float k = float(job.wavenumber), b = float(job.band);
    for (int64_t n = 0; n < kSeen; n++) {
      const float x = reference.axis[n % 4] + mixed.xi[n], y = reference.axis[4 + n / 4] + mixed.eta[n];
      const float cx = k * magnitude(pulse.xi[n] - x) + b * magnitude(pulse.xi[n]);
      const float cy = k * magnitude(pulse.eta[n] - y) + b * magnitude(pulse.eta[n]);
      xi[n] = cx <= xi[n] ? xi[n] : cx, eta[n] = cy <= eta[n] ? eta[n] : cy;  // no number stays
    }
  }
  static float most(const float* values) {
    float value = 0;
    for (int64_t n = 0; n < kSeen; n++) value = values[n] <= value ? value : values[n];
    return value;
  }
};

// Slopes of the first, middle and last pulse of each leaf, and how much a stray pulse among them may add to the band.
struct Leaves {
  std::vector<Slopes> slopes;
  std::vector<float> stray_xi, stray_eta;
};

inline float length_of(const float (*by)[kSeen]) {
  float most = 0;
  for (int64_t n = 0; n < kSeen; n++)
    most = std::max(most, by[0][n] * by[0][n] + by[1][n] * by[1][n] + by[2][n] * by[2][n]);
  return std::sqrt(most);
}

inline Leaves leaves_of(const TreeJob& job, const TreeTile& tile, const Seen& seen) {
  const int64_t size = job.sizes[0], count = apertura::subapertures(job, 0);
  Leaves leaves{std::vector<Slopes>(size_t(3 * count)), std::vector<float>(size_t(count)), {}};
  leaves.stray_eta = leaves.stray_xi;
  const float xi = length_of(seen.by_xi), eta = length_of(seen.by_eta);
  for (int64_t n = 0; n < count; n++) {
    const int64_t begin = n * size, end = std::min(begin + size, job.pulses) - 1;
    const int64_t pulses[3] = {begin, (begin + end) / 2, end};
    for (int64_t i = 0; i < 3; i++) {
      const Legs legs = legs_of(job, tile.centre, pulses[i]);
      leaves.slopes[3 * n + i] = slopes_at(legs, seen);
      if (i != 1) continue;
      const float turn = float(job.wavenumber) * job.stray[n] * (1 / legs.ranges[0] + 1 / legs.ranges[1]);
      leaves.stray_xi[n] = turn * xi, leaves.stray_eta[n] = turn * eta;
    }
  }
  return leaves;
}

// Node counts of one level. Returns whether the nodes there are do for all subapertures that any pulse takes.
inline bool plan_level(const TreeJob& job, TreeTile& tile, const Seen& seen, const Leaves& leaves, const Slopes& mixed,
                       int64_t level) {
  const int64_t size = job.sizes[level], leaf = job.sizes[0];
  uint8_t* nodes = tile.nodes + apertura::first_of_level(job, level);
  bool holds = true;
  for (int64_t begin = 0; begin < job.pulses; begin += size, nodes += 2) {
    const int64_t end = std::min(begin + size, job.pulses);
    const Slopes reference =
        slopes_at(legs_of(job, tile.centre, apertura::middle_of(job, begin, size)), seen);
    Band band;
    float stray_xi = 0, stray_eta = 0;
    bool taken = false;
    for (int64_t n = begin / leaf; n * leaf < end; n++) {
      if (tile.way[n * leaf / kTreeGroup] != apertura::kByTree) continue;
      taken = true;
      for (int64_t i = 0; i < 3; i++) band.include(job, leaves.slopes[3 * n + i], reference, mixed);
      stray_xi = std::max(stray_xi, leaves.stray_xi[n]), stray_eta = std::max(stray_eta, leaves.stray_eta[n]);
    }
    const double more = tile.weight ? apertura::kTreeWeighted : 0;
    const int64_t xi = nodes_for(job, Band::most(band.xi) + stray_xi + more);
    const int64_t eta = nodes_for(job, Band::most(band.eta) + stray_eta + more);
    holds &= !taken || (xi <= kTreeNodes && eta <= kTreeNodes);
    nodes[0] = uint8_t(std::min(xi, kTreeNodes)), nodes[1] = uint8_t(std::min(eta, kTreeNodes));
  }
  return holds;
}

inline void plan_tile(const TreeJob& job, TreeTile& tile, std::vector<int64_t>& last) {
  const Seen seen = seen_of(tile);
  mark_groups(job, tile, seen, last);
  Slopes mixed = slopes_at(shared_legs(job, tile), seen);
  for (int64_t n = 0; n < kSeen; n++) mixed.xi[n] -= mixed.axis[n % 4], mixed.eta[n] -= mixed.axis[4 + n / 4];
  const Leaves leaves = leaves_of(job, tile, seen);
  tile.top = -1;
  for (int64_t level = 0; level < job.levels && tile.top == level - 1; level++)
    if (plan_level(job, tile, seen, leaves, mixed, level)) tile.top = level;
}

// Plans all tiles, and which samples of each pulse are expanded.
inline void plan_tree(TreeJob& job) {
  std::vector<int64_t> last(size_t(job.pulses), INT64_MIN);
  std::fill(job.first, job.first + job.pulses, INT64_MAX);
  for (int64_t n = 0; n < job.count; n++) plan_tile(job, job.tiles[n], last);
  job.expanded = 0;
  for (int64_t p = 0; p < job.pulses; p++) {
    if (job.first[p] > last[p]) job.first[p] = 0, last[p] = 0;  // no tile takes it by tree
    job.expanded = std::max(job.expanded, last[p] - job.first[p] + 1);
  }
}

}  // namespace
