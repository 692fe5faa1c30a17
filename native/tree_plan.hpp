// Plan of a tile's tree: nodes of each subaperture, virtual pulses of each leaf, and pulses that the tree cannot sum.
// Numbers in brackets are equations of docs/theory/tree.md, "Support" and "Leaves".
#pragma once
#include "tree_weight.hpp"

namespace {

using apertura::kTreeCurves;
using apertura::kTreeNodes;
using apertura::kTreeVirtualMargin;
using apertura::kTreeWeighted;

constexpr float kAiry = 3;  // units of (4b) beyond which the spectrum is negligible

// Paths of a leaf's pulses over the tile.
struct LeafPaths {
  Reach reach[3];                      // of the first, middle and last pulse
  double low, high;                    // over all pulses
  bool inside = true, outside = true;  // all pulses are inside, or outside, of their profiles
};

// Every eighth pulse is evaluated; pulses between them may exceed their range by half the difference of neighbours.
inline LeafPaths paths_of_leaf(const TreeJob& job, const TreeTile& tile, const Lattice& lattice, int64_t begin,
                               int64_t end) {
  LeafPaths paths;
  const double margin = double(apertura::kTreeMargin + (job.taps_count + apertura::kTreeDelays) / 2);  // filters
  const double length = double(job.length - 1);
  const int64_t three[3] = {begin, (begin + end - 1) / 2, end - 1};
  double slack = 0;
  Reach last;
  int64_t checked = begin;  // first pulse that has not been compared with its profile
  for (int64_t n = begin; n < end; n += n + 8 < end || n == end - 1 ? 8 : end - 1 - n) {
    const Reach reach = reach_of(legs_of(job, tile.centre, n), lattice);
    if (n == begin) last = reach, paths.low = reach.low, paths.high = reach.high;
    const double apart = 0.5 * std::max(std::fabs(reach.low - last.low), std::fabs(reach.high - last.high));
    for (; checked <= n; checked++) {  // each profile has its own start
      const double centre = legs_of(job, tile.centre, checked).range - job.start[checked];
      const double low = (centre + std::min(reach.low, last.low) - apart) / job.step;
      const double high = (centre + std::max(reach.high, last.high) + apart) / job.step;
      paths.inside &= low >= margin && high <= length - margin;
      paths.outside &= high <= -margin || low >= length + margin;
    }
    paths.low = std::min(paths.low, reach.low), paths.high = std::max(paths.high, reach.high);
    slack = std::max(slack, apart), last = reach;
  }
  paths.low -= slack, paths.high += slack;
  for (int64_t n = 0; n < 3; n++) paths.reach[n] = reach_of(legs_of(job, tile.centre, three[n]), lattice);
  return paths;
}

// Smallest number of nodes that supports a band in rad per half tile; kTreeNodes + 1 if none does.
inline int64_t nodes_for(const TreeJob& job, double band) {
  if (!(band <= job.supports[kTreeNodes])) return kTreeNodes + 1;
  return std::max<int64_t>(2, std::lower_bound(job.supports, job.supports + kTreeNodes + 1, band) - job.supports);
}

// (8b) per metre of track residual: phase in the corner of a tile, divided by sqrt 3 for the RMS over the tile.
inline double residual_turn(const TreeJob& job, const TreeTile& tile, const Lattice& lattice, int64_t pulse) {
  const Legs legs = legs_of(job, tile.centre, pulse);
  return 0.577 * (job.wavenumber + job.band) * lattice.radius / std::min(legs.ranges[0], legs.ranges[1]);
}

// Band of (8) along a leaf, rad per half leaf: largest over all points relative to the centre, from the first, middle
// and last pulse.
inline double carrier_turn(const TreeJob& job, const Lattice& lattice, const Reach* reach) {
  double most = 0;
  for (int64_t n = 0; n < lattice.count; n++) {
    const double first = reach[0].extra_path[n], middle = reach[1].extra_path[n], last = reach[2].extra_path[n];
    most = std::max(most, 0.5 * std::fabs(last - first) + std::fabs(first + last - 2 * middle));
  }
  return (job.wavenumber + job.band) * most;
}

// Number of virtual pulses that replace those of a leaf; 0: no replacement.
inline uint8_t virtual_pulses_for(const TreeJob& job, const TreeTile& tile, const Lattice& lattice,
                                  const LeafPaths& paths, int64_t leaf) {
  const int64_t begin = leaf * kTreeGroup;
  if (tile.n_virtual_pulses[leaf] || begin + kTreeGroup > job.pulses) return 0;  // weights jump, or the leaf is short
  // (8b): the curve of lowest degree with a tolerated residual of the track.
  const double per_metre = residual_turn(job, tile, lattice, begin + kTreeGroup / 2);
  const float* residual = job.rms_track_residual + leaf * kTreeCurves;
  int64_t curve = 0;
  while (curve < kTreeCurves && !(residual[curve] * per_metre <= job.presum_error)) curve++;
  if (curve == kTreeCurves) return 0;
  // (8): bands of the carrier, of track residuals from the parabola, of antennas (1.5 rad) and of an edge (13).
  const Legs legs = legs_of(job, tile.centre, begin + kTreeGroup / 2);
  const double turns = (1 / legs.ranges[0] + 1 / legs.ranges[1]) * (job.wavenumber + job.band) * lattice.radius;
  double band = carrier_turn(job, lattice, paths.reach) + job.max_track_residual[leaf] * turns;
  if (tile.weight) band += kTreeWeighted;
  if (tile.edge[leaf]) band += widened(job, tile.slope[3 * leaf + 2], band);
  const int64_t count = std::max(job.curve_degrees[curve] + kTreeVirtualMargin, nodes_for(job, band));
  return count <= apertura::kTreeMostVirtual ? uint8_t(count) : 0;
}

// Sets the variant of each leaf, its virtual pulses, and the sample range of all leaves summed by tree.
inline void plan_leaves(const TreeJob& job, TreeTile& tile, const Lattice& lattice) {
  double low = 0, high = 0;
  weigh_leaves(job, tile, lattice);
  for (int64_t leaf = 0; leaf * kTreeGroup < job.pulses; leaf++) {
    if (tile.variant[leaf] != apertura::kByTree) continue;
    const int64_t begin = leaf * kTreeGroup, end = std::min(begin + kTreeGroup, job.pulses);
    const LeafPaths paths = paths_of_leaf(job, tile, lattice, begin, end);
    tile.variant[leaf] = paths.inside ? apertura::kByTree : paths.outside ? kNoEcho : kDirectly;
    if (!paths.inside) continue;
    tile.n_virtual_pulses[leaf] = virtual_pulses_for(job, tile, lattice, paths, leaf);
    low = std::min(low, paths.low), high = std::max(high, paths.high);
  }
  tile.first_path = (std::floor(low / job.step) - double(apertura::kTreeMargin)) * job.step;
  tile.samples = int64_t(std::ceil((high - tile.first_path) / job.step)) + apertura::kTreeMargin + 1;
}

// Slopes of a subaperture's reference over the tile: slopes along the axes, and the mixed part.
struct Reference {
  alignas(64) float xi[kLattice], eta[kLattice];
  Reference(const Slopes& middle, const Slopes& mixed, const Lattice& lattice) {
    for (int64_t n = 0; n < lattice.count; n++) {
      xi[n] = middle.axis[n % lattice.side] + mixed.xi[n];
      eta[n] = middle.axis[lattice.side + n / lattice.side] + mixed.eta[n];
    }
  }
};

// Parabola through a value and its two neighbours: height of its peak above the value, and its curvature; 0 if the peak
// is not between the neighbours.
struct Peak {
  float above = 0, bend = 0;
  Peak(const float* value, int64_t step) {
    const float before = value[-step], behind = value[step], second = 2 * *value - before - behind;
    const float rise = behind - before;
    if (second > 0 && rise <= 2 * second && -rise <= 2 * second) above = rise * rise / (8 * second), bend = second;
  }
};

// (4): residual band of pulses on a tile, relative to the reference of their subaperture.
struct Band {
  float xi[kLattice] = {}, eta[kLattice] = {};
  void include(const TreeJob& job, const Slopes& pulse, const Reference& reference, const Lattice& lattice) {
    const float k = float(job.wavenumber), b = float(job.band);
    for (int64_t n = 0; n < lattice.count; n++) {
      const float cx = k * magnitude(pulse.xi[n] - reference.xi[n]) + b * magnitude(pulse.xi[n]);
      const float cy = k * magnitude(pulse.eta[n] - reference.eta[n]) + b * magnitude(pulse.eta[n]);
      xi[n] = cx <= xi[n] ? xi[n] : cx, eta[n] = cy <= eta[n] ? eta[n] : cy;  // keeps a NaN
    }
  }
  // Largest band over the tile for interpolation along the axis of `step`: includes peaks between points, by parabolas,
  // and the extension (4b) of the spectrum beyond the largest slope.
  static float most(const float* values, const Lattice& lattice, int64_t step) {
    const int64_t side = lattice.side, across = step == 1 ? side : 1;
    const float bend = float((side - 1) * (side - 1)) / 8;
    float most = 0;
    for (int64_t n = 0; n < lattice.count; n++) {
      float value = values[n];
      if (n / across % side % (side - 1)) value += Peak(values + n, across).above;
      if (n / step % side % (side - 1)) {
        const Peak peak(values + n, step);
        if (peak.bend > 0) value += peak.above + kAiry * __builtin_cbrtf(peak.bend * bend);
      }
      most = value <= most ? most : value;
    }
    return most;
  }
};

// Slopes of the first, middle and last pulse of each leaf, and the additional band of track residuals from the parabola
// through them.
struct Leaves {
  std::vector<Slopes> slopes;
  std::vector<float> residual_xi, residual_eta;
};

inline float length_of(const float (*by)[kLattice], const Lattice& lattice) {
  float most = 0;
  for (int64_t n = 0; n < lattice.count; n++)
    most = std::max(most, by[0][n] * by[0][n] + by[1][n] * by[1][n] + by[2][n] * by[2][n]);
  return std::sqrt(most);
}

inline Leaves leaves_of(const TreeJob& job, const TreeTile& tile, const Lattice& lattice) {
  const int64_t size = job.sizes[0], count = apertura::subapertures(job, 0);
  Leaves leaves{std::vector<Slopes>(size_t(3 * count)), std::vector<float>(size_t(count)), {}};
  leaves.residual_eta = leaves.residual_xi;
  const float xi = length_of(lattice.by_xi, lattice), eta = length_of(lattice.by_eta, lattice);
  for (int64_t n = 0; n < count; n++) {
    const int64_t begin = n * size, end = std::min(begin + size, job.pulses) - 1;
    const int64_t pulses[3] = {begin, (begin + end) / 2, end};
    if (tile.variant[begin / kTreeGroup] != apertura::kByTree) continue;
    for (int64_t i = 0; i < 3; i++) {
      const Legs legs = legs_of(job, tile.centre, pulses[i]);
      leaves.slopes[3 * n + i] = slopes_at(legs, lattice);
      if (i != 1) continue;
      const float turn = float(job.wavenumber) * job.max_track_residual[n] * (1 / legs.ranges[0] + 1 / legs.ranges[1]);
      leaves.residual_xi[n] = turn * xi, leaves.residual_eta[n] = turn * eta;
    }
  }
  return leaves;
}

// Slopes of m of (3): slopes at the middle pulse of the chunk minus their values on the axes.
inline Slopes mixed_slopes(const TreeJob& job, const TreeTile& tile, const Lattice& lattice) {
  Slopes mixed = slopes_at(shared_legs(job, tile), lattice);
  for (int64_t n = 0; n < lattice.count; n++)
    mixed.xi[n] -= mixed.axis[n % lattice.side], mixed.eta[n] -= mixed.axis[lattice.side + n / lattice.side];
  return mixed;
}

// (4) for a subaperture, from its leaves that are summed by tree.
inline Band band_of(const TreeJob& job, const TreeTile& tile, const Lattice& lattice, const Leaves& leaves,
                    const Slopes& mixed, int64_t begin, int64_t size) {
  const int64_t middle = apertura::middle_of(job, begin, size), end = std::min(begin + size, job.pulses);
  const Reference reference(slopes_at(legs_of(job, tile.centre, middle), lattice), mixed, lattice);
  Band band;
  for (int64_t n = begin / job.sizes[0]; n * job.sizes[0] < end; n++)
    for (int64_t i = 0; i < 3 && tile.variant[n * job.sizes[0] / kTreeGroup] == apertura::kByTree; i++)
      band.include(job, leaves.slopes[3 * n + i], reference, lattice);
  return band;
}

// Returns true if any of the pulses begin … end is summed by tree.
inline bool any_taken(const TreeJob& job, const TreeTile& tile, int64_t begin, int64_t end) {
  for (int64_t p = begin; p < end && p < job.pulses; p += apertura::kTreeGroup)
    if (tile.variant[p / apertura::kTreeGroup] == apertura::kByTree) return true;
  return false;
}

// Sets the node counts of one level. Returns true if kTreeNodes suffice for all subapertures with a leaf by tree.
inline bool plan_level(const TreeJob& job, TreeTile& tile, const Lattice& lattice, const Leaves& leaves,
                       const Slopes& mixed, int64_t level) {
  const int64_t size = job.sizes[level], leaf = job.sizes[0];
  uint8_t* nodes = tile.nodes + apertura::first_of_level(job, level);
  bool holds = true;
  for (int64_t begin = 0; begin < job.pulses; begin += size, nodes += 2) {
    const int64_t end = std::min(begin + size, job.pulses);
    nodes[0] = nodes[1] = 2;
    if (!any_taken(job, tile, begin, end)) continue;
    const Band band = band_of(job, tile, lattice, leaves, mixed, begin, size);
    float residual_xi = 0, residual_eta = 0, slope_xi = 0, slope_eta = 0;
    bool edge = false;
    for (int64_t n = begin / leaf; n * leaf < end; n++) {
      if (tile.variant[n * leaf / kTreeGroup] != apertura::kByTree) continue;
      residual_xi = std::max(residual_xi, leaves.residual_xi[n]);
      residual_eta = std::max(residual_eta, leaves.residual_eta[n]);
      if (!tile.edge[n]) continue;
      edge = true;
      slope_xi = std::max(slope_xi, tile.slope[3 * n]), slope_eta = std::max(slope_eta, tile.slope[3 * n + 1]);
    }
    // Sum of (4b), track residuals, antennas (1.5 rad) and the edge of a sector (13).
    double wide_xi = Band::most(band.xi, lattice, 1) + residual_xi + (tile.weight ? kTreeWeighted : 0);
    double wide_eta = Band::most(band.eta, lattice, lattice.side) + residual_eta + (tile.weight ? kTreeWeighted : 0);
    if (edge) wide_xi += widened(job, slope_xi, wide_xi), wide_eta += widened(job, slope_eta, wide_eta);
    const int64_t xi = nodes_for(job, wide_xi), eta = nodes_for(job, wide_eta);
    if (level == 0 && edge && (xi > kTreeNodes || eta > kTreeNodes)) {
      tile.variant[begin / kTreeGroup] = kDirectly;  // the edge is too steep in this leaf only
      continue;
    }
    holds &= xi <= kTreeNodes && eta <= kTreeNodes;
    nodes[0] = uint8_t(std::min(xi, kTreeNodes)), nodes[1] = uint8_t(std::min(eta, kTreeNodes));
  }
  return holds;
}

inline void plan_tile(const TreeJob& job, TreeTile& tile) {
  const Lattice lattice = lattice_of(job, tile);
  plan_leaves(job, tile, lattice);
  const Slopes mixed = mixed_slopes(job, tile, lattice);
  const Leaves leaves = leaves_of(job, tile, lattice);
  tile.top = -1;
  for (int64_t level = 0; level < job.levels && tile.top == level - 1; level++)
    if (plan_level(job, tile, lattice, leaves, mixed, level)) tile.top = level;
}

}  // namespace
