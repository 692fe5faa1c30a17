// How many nodes each subaperture of a tile needs, and which pulses its tree can take. docs/theory/tree.md, "Support".
#pragma once
#include "tree_weight.hpp"

namespace {

using apertura::kTreeCurves;
using apertura::kTreeMore;
using apertura::kTreeNodes;
using apertura::kTreeWeighted;

constexpr int64_t kCurves[kTreeCurves] = {5, 9, 14, 20};  // degrees of smooth curves over a leaf
constexpr float kAiry = 3;                                // units of (4b) beyond which nothing is left

// What is known of a leaf before its nodes: how its pulses see the tile.
struct Sight {
  Reach reach[3];    // of its first, middle and last pulse
  double low, high;  // of all of them
  bool inside = true, outside = true;
};

// Pulses between those looked at may reach as much further as neighbours of them differ.
inline Sight sight_of(const TreeJob& job, const TreeTile& tile, const Seen& seen, int64_t begin, int64_t end) {
  Sight sight;
  const double margin = double(apertura::kTreeMargin + (job.taps_count + apertura::kTreeDelays) / 2);  // of filters
  const double length = double(job.length - 1);
  const int64_t three[3] = {begin, (begin + end - 1) / 2, end - 1};
  double slack = 0;
  Reach last;
  int64_t seen_to = begin;
  for (int64_t n = begin; n < end; n += n + 8 < end || n == end - 1 ? 8 : end - 1 - n) {
    const Reach reach = reach_of(legs_of(job, tile.centre, n), seen);
    if (n == begin) last = reach, sight.low = reach.low, sight.high = reach.high;
    const double apart = 0.5 * std::max(std::fabs(reach.low - last.low), std::fabs(reach.high - last.high));
    for (; seen_to <= n; seen_to++) {  // each profile may begin where it likes
      const double centre = legs_of(job, tile.centre, seen_to).range - job.start[seen_to];
      const double low = (centre + std::min(reach.low, last.low) - apart) / job.step;
      const double high = (centre + std::max(reach.high, last.high) + apart) / job.step;
      sight.inside &= low >= margin && high <= length - margin;
      sight.outside &= high <= -margin || low >= length + margin;
    }
    sight.low = std::min(sight.low, reach.low), sight.high = std::max(sight.high, reach.high);
    slack = std::max(slack, apart), last = reach;
  }
  sight.low -= slack, sight.high += slack;
  for (int64_t n = 0; n < 3; n++) sight.reach[n] = reach_of(legs_of(job, tile.centre, three[n]), seen);
  return sight;
}

// The least number of nodes that holds a band, rad per half tile; more than kTreeNodes where none does.
inline int64_t nodes_for(const TreeJob& job, double band) {
  if (!(band <= job.supports[kTreeNodes])) return kTreeNodes + 1;
  return std::max<int64_t>(2, std::lower_bound(job.supports, job.supports + kTreeNodes + 1, band) - job.supports);
}

// How many pulses stand for those of a leaf: what holds the turn of the carrier at any place against the centre.
inline uint8_t fewer_of(const TreeJob& job, const TreeTile& tile, const Seen& seen, const Sight& sight, int64_t leaf) {
  const int64_t begin = leaf * kTreeGroup;
  if (tile.fewer[leaf] || begin + kTreeGroup > job.pulses) return 0;  // weights that jump
  const Legs legs = legs_of(job, tile.centre, begin + kTreeGroup / 2);
  const double turns = (1 / legs.ranges[0] + 1 / legs.ranges[1]) * (job.wavenumber + job.band) * seen.radius;
  // What a place off the centre sees of a pulse off its curve, RMS over the tile: 1/sqrt 3 of what its corner sees.
  const double rest = 0.577 * (job.wavenumber + job.band) * seen.radius / std::min(legs.ranges[0], legs.ranges[1]);
  const float* rough = job.rough + leaf * kTreeCurves;
  int64_t terms = 0;
  while (terms < kTreeCurves && !(rough[terms] * rest <= job.smooth)) terms++;
  if (terms == kTreeCurves) return 0;
  double most = 0;
  for (int64_t n = 0; n < seen.count; n++) {
    const double first = sight.reach[0].further[n], middle = sight.reach[1].further[n],
                 last = sight.reach[2].further[n];
    most = std::max(most, 0.5 * std::fabs(last - first) + std::fabs(first + last - 2 * middle));
  }
  double band = (job.wavenumber + job.band) * most + job.stray[leaf] * turns + (tile.weight ? kTreeWeighted : 0);
  if (tile.edge[leaf]) band += widened(job, tile.slope[3 * leaf + 2], band);
  const int64_t count = std::max(kCurves[terms] + kTreeMore, nodes_for(job, band));
  return count <= apertura::kTreeFewer ? uint8_t(count) : 0;
}

// Looks at each leaf: whether it goes by tree, over which samples, and as how many pulses.
inline void plan_leaves(const TreeJob& job, TreeTile& tile, const Seen& seen) {
  double low = 0, high = 0;
  weigh_leaves(job, tile, seen);
  for (int64_t leaf = 0; leaf * kTreeGroup < job.pulses; leaf++) {
    if (tile.way[leaf] != apertura::kByTree) continue;
    const int64_t begin = leaf * kTreeGroup, end = std::min(begin + kTreeGroup, job.pulses);
    const Sight sight = sight_of(job, tile, seen, begin, end);
    tile.way[leaf] = sight.inside ? apertura::kByTree : sight.outside ? kSilently : kDirectly;
    if (!sight.inside) continue;
    tile.fewer[leaf] = fewer_of(job, tile, seen, sight, leaf);
    low = std::min(low, sight.low), high = std::max(high, sight.high);
  }
  tile.first_path = (std::floor(low / job.step) - double(apertura::kTreeMargin)) * job.step;
  tile.samples = int64_t(std::ceil((high - tile.first_path) / job.step)) + apertura::kTreeMargin + 1;
}

// Slopes of the reference of a subaperture over the tile: those along the axes, and the mixed part.
struct Reference {
  alignas(64) float xi[kSeen], eta[kSeen];
  Reference(const Slopes& middle, const Slopes& mixed, const Seen& seen) {
    for (int64_t n = 0; n < seen.count; n++) {
      xi[n] = middle.axis[n % seen.side] + mixed.xi[n];
      eta[n] = middle.axis[seen.side + n / seen.side] + mixed.eta[n];
    }
  }
};

// The parabola through a value and those beside it: by how much it peaks above, and how sharply; 0 if not among them.
struct Peak {
  float above = 0, bend = 0;
  Peak(const float* value, int64_t step) {
    const float before = value[-step], behind = value[step], second = 2 * *value - before - behind;
    const float rise = behind - before;
    if (second > 0 && rise <= 2 * second && -rise <= 2 * second) above = rise * rise / (8 * second), bend = second;
  }
};

// (4): the band left on a tile by pulses against the reference of their subaperture.
struct Band {
  float xi[kSeen] = {}, eta[kSeen] = {};
  void include(const TreeJob& job, const Slopes& pulse, const Reference& reference, const Seen& seen) {
    const float k = float(job.wavenumber), b = float(job.band);
    for (int64_t n = 0; n < seen.count; n++) {
      const float cx = k * magnitude(pulse.xi[n] - reference.xi[n]) + b * magnitude(pulse.xi[n]);
      const float cy = k * magnitude(pulse.eta[n] - reference.eta[n]) + b * magnitude(pulse.eta[n]);
      xi[n] = cx <= xi[n] ? xi[n] : cx, eta[n] = cy <= eta[n] ? eta[n] : cy;  // no number stays
    }
  }
  // Of any place, `step` the axis along which it is interpolated: where it peaks between places, by parabolas, and what
  // a phase whose slope peaks has beyond that slope (4b).
  static float most(const float* values, const Seen& seen, int64_t step) {
    const int64_t side = seen.side, across = step == 1 ? side : 1;
    const float bend = float((side - 1) * (side - 1)) / 8;
    float most = 0;
    for (int64_t n = 0; n < seen.count; n++) {
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

// Slopes of the first, middle and last pulse of each leaf, and how much a stray pulse among them may add to the band.
struct Leaves {
  std::vector<Slopes> slopes;
  std::vector<float> stray_xi, stray_eta;
};

inline float length_of(const float (*by)[kSeen], const Seen& seen) {
  float most = 0;
  for (int64_t n = 0; n < seen.count; n++)
    most = std::max(most, by[0][n] * by[0][n] + by[1][n] * by[1][n] + by[2][n] * by[2][n]);
  return std::sqrt(most);
}

inline Leaves leaves_of(const TreeJob& job, const TreeTile& tile, const Seen& seen) {
  const int64_t size = job.sizes[0], count = apertura::subapertures(job, 0);
  Leaves leaves{std::vector<Slopes>(size_t(3 * count)), std::vector<float>(size_t(count)), {}};
  leaves.stray_eta = leaves.stray_xi;
  const float xi = length_of(seen.by_xi, seen), eta = length_of(seen.by_eta, seen);
  for (int64_t n = 0; n < count; n++) {
    const int64_t begin = n * size, end = std::min(begin + size, job.pulses) - 1;
    const int64_t pulses[3] = {begin, (begin + end) / 2, end};
    if (tile.way[begin / kTreeGroup] != apertura::kByTree) continue;
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

// Whether any of some pulses goes by the tree of a tile.
inline bool any_taken(const TreeJob& job, const TreeTile& tile, int64_t begin, int64_t end) {
  for (int64_t p = begin; p < end && p < job.pulses; p += apertura::kTreeGroup)
    if (tile.way[p / apertura::kTreeGroup] == apertura::kByTree) return true;
  return false;
}

// Node counts of one level. Returns whether the nodes there are do for all subapertures that any pulse takes.
inline bool plan_level(const TreeJob& job, TreeTile& tile, const Seen& seen, const Leaves& leaves, const Slopes& mixed,
                       int64_t level) {
  const int64_t size = job.sizes[level], leaf = job.sizes[0];
  uint8_t* nodes = tile.nodes + apertura::first_of_level(job, level);
  bool holds = true;
  for (int64_t begin = 0; begin < job.pulses; begin += size, nodes += 2) {
    const int64_t end = std::min(begin + size, job.pulses);
    nodes[0] = nodes[1] = 2;
    if (!any_taken(job, tile, begin, end)) continue;
    const Slopes middle = slopes_at(legs_of(job, tile.centre, apertura::middle_of(job, begin, size)), seen);
    const Reference reference(middle, mixed, seen);
    Band band;
    float stray_xi = 0, stray_eta = 0, slope_xi = 0, slope_eta = 0;
    bool edge = false;
    for (int64_t n = begin / leaf; n * leaf < end; n++) {
      if (tile.way[n * leaf / kTreeGroup] != apertura::kByTree) continue;
      for (int64_t i = 0; i < 3; i++) band.include(job, leaves.slopes[3 * n + i], reference, seen);
      stray_xi = std::max(stray_xi, leaves.stray_xi[n]), stray_eta = std::max(stray_eta, leaves.stray_eta[n]);
      if (!tile.edge[n]) continue;
      edge = true;
      slope_xi = std::max(slope_xi, tile.slope[3 * n]), slope_eta = std::max(slope_eta, tile.slope[3 * n + 1]);
    }
    double wide_xi = Band::most(band.xi, seen, 1) + stray_xi + (tile.weight ? kTreeWeighted : 0);
    double wide_eta = Band::most(band.eta, seen, seen.side) + stray_eta + (tile.weight ? kTreeWeighted : 0);
    if (edge) wide_xi += widened(job, slope_xi, wide_xi), wide_eta += widened(job, slope_eta, wide_eta);
    const int64_t xi = nodes_for(job, wide_xi), eta = nodes_for(job, wide_eta);
    if (level == 0 && edge && (xi > kTreeNodes || eta > kTreeNodes)) {
      tile.way[begin / kTreeGroup] = kDirectly;  // the rest of the tile need not follow
      continue;
    }
    holds &= xi <= kTreeNodes && eta <= kTreeNodes;
    nodes[0] = uint8_t(std::min(xi, kTreeNodes)), nodes[1] = uint8_t(std::min(eta, kTreeNodes));
  }
  return holds;
}

inline void plan_tile(const TreeJob& job, TreeTile& tile) {
  const Seen seen = seen_of(job, tile);
  plan_leaves(job, tile, seen);
  Slopes mixed = slopes_at(shared_legs(job, tile), seen);
  for (int64_t n = 0; n < seen.count; n++)
    mixed.xi[n] -= mixed.axis[n % seen.side], mixed.eta[n] -= mixed.axis[seen.side + n / seen.side];
  const Leaves leaves = leaves_of(job, tile, seen);
  tile.top = -1;
  for (int64_t level = 0; level < job.levels && tile.top == level - 1; level++)
    if (plan_level(job, tile, seen, leaves, mixed, level)) tile.top = level;
}

}  // namespace
