// Structs passed from Python for a subaperture tree: one chunk of pulses on several tiles of pixels. Mirrored field by
// field in `core/backprojection/engines/native_binding.py`; contract.cpp lists the layout. docs/theory/tree.md derives
// the algorithm.
#pragma once
#include <cstdint>

#include "job.hpp"

namespace apertura {

constexpr int64_t kTreeNodes = 128;        // maximum nodes along one axis of a tile
constexpr int64_t kTreeSide = 256;         // maximum pixels along a tile
constexpr int64_t kTreeLevels = 4;         // maximum levels
constexpr int64_t kTreeGroup = 64;         // pulses of a leaf, which all have one variant
constexpr int64_t kTreeDelays = 12;        // taps of the filter that aligns a pulse to a tile
constexpr int64_t kTreeMostVirtual = 28;   // maximum virtual (presummed) pulses that replace those of a leaf
constexpr int64_t kTreeCurves = 4;         // number of tried degrees of the curve through a leaf's track
constexpr int64_t kTreeTerms = 21;         // polynomial terms of the track over a leaf: the largest degree plus one
constexpr int64_t kTreeVirtualMargin = 4;  // virtual pulses of a curve in addition to its degree
constexpr int64_t kTreeSlots = 136;        // 0 … kTreeNodes: number of nodes; above: pixels along one of the tile sides
constexpr int64_t kTreeDegree = 6;         // maximum degree of a tile's surface
constexpr int64_t kTreeWeights = 16;   // terms of the antennas' polynomial over a tile: ξ^a η^b at 4 b + a, a, b ≤ 3
constexpr int64_t kTreeMargin = 2;     // samples around the range of a tile's paths
constexpr double kTreeWeighted = 1.5;  // rad by which smooth weights increase the band at a tile's nodes

// Summation of a group of pulses over a tile: by tree, directly, or (kNoEcho) not at all, because profile, antennas or
// sector do not reach the tile.
enum TreeVariant : uint8_t { kByTree, kDirectly, kNoEcho };

}  // namespace apertura

struct TreeTile {
  const double* surface;  // (degree + 1 along η, degree + 1 along ξ, 3): Legendre coefficients of the pixel positions
  const double* pixels;   // position of the first pixel; rows have a stride of TreeJob.stride pixels
  float* image;           // first pixel of the image, (re, im), with the same stride
  float* weight;          // (pulse, kTreeWeights): gain of both antennas over the tile, set by the plan; null: no beams
  uint8_t* variant;       // (group): TreeVariant; groups that are not kByTree on entry are unchanged
  uint8_t* nodes;         // (subaperture, 2), level after level: nodes along ξ and η
  // (leaf): virtual pulses that replace those of a leaf; 0: each pulse is summed individually. Between
  // apertura_weigh_tree and the plan, 1 marks weights that jump from pulse to pulse, which exclude virtual pulses; zero
  // on entry.
  uint8_t* n_virtual_pulses;
  uint8_t* edge;  // (leaf): 1 if the edge of the sector crosses the tile; zero on entry
  float* slope;   // (leaf, 3): for leaves at an edge, change of depth over half a tile along ξ and η, and half a leaf
  float* band;    // (subaperture, 2), level after level: (4b) along ξ and η, rad per half tile; by apertura_view_tree
  float* turn;    // (leaf, 2): carrier phase over half a leaf, rad, and (8b) in rad per metre; by apertura_view_tree
  double centre[3];
  double rest;        // mean square of the pixels' distances from the surface; set by apertura_rest_tree
  double first_path;  // path of the first sample minus that of the centre; set by the plan
  double span,
      slope_rms;  // total path across the tile, and RMS of its slope, metres per half tile; by apertura_view_tree
  int64_t degree, rows, columns, row_slot, column_slot;
  int64_t samples;  // samples per pulse over the tile; set by the plan
  int64_t top;      // level at which pixels are formed; -1: the tile is not formed by tree
};

struct TreeJob {
  const float* samples;             // (pulse, length, 2)
  const double* start;              // (pulse): total path of sample 0
  const double* transmitter;        // (pulse, 3)
  const double* receiver;           // (pulse, 3)
  const float* max_track_residual;  // (leaf): largest distance of pulses from the parabola through three of them, m
  const float* rms_track_residual;  // (leaf, kTreeCurves): RMS distance from curves of increasing degree, metres
  const double* track;  // (leaf, antenna, kTreeTerms, 3): phase centres as polynomials, orthonormal over the leaf
  const float* taps;    // (taps_count, up, 2, 2): filters of level and slope, each twice (for re, im)
  const float* delay;   // (delay_terms, kTreeDelays): polynomials of the fraction of a sample
  const float* const* presum;   // (kTreeMostVirtual + 1): weights (virtual pulse, pulse of a leaf)
  const double* const* curve;   // (kTreeMostVirtual + 1): polynomials of `track` at (virtual pulse, kTreeTerms)
  const double* supports;       // (kTreeNodes + 1): band supported by a number of nodes, rad per half tile
  const double* const* places;  // (kTreeSlots): nodes or pixels along an axis, -1 … 1
  const float* const* spread;   // (kTreeNodes + 1, kTreeSlots): (node, 2 padded): weights, each twice
  const float* const* mix;      // (kTreeNodes + 1, kTreeSlots): (target, node): weights of `spread`
  TreeTile* tiles;
  int64_t pulses, length, up, lead, stride, count, levels, mono, phase_polynomial;
  int64_t taps_count, delay_terms;
  int64_t sizes[apertura::kTreeLevels];  // pulses of a subaperture
  int64_t curve_degrees[apertura::kTreeCurves];
  double step, wavenumber, band;  // metres; 2 pi f / c, rad/m; half the band, rad/m
  double presum_error;            // tolerated (8b), rad RMS
  double node_error;              // tolerated relative RMS error of one interpolation between nodes
  const BeamJob* beam[2];         // as in ApertureJob, with axes of stride `pulses`
  const SectorJob* sector;
  float phase_coefficients[9];
};

namespace apertura {

static inline int64_t subapertures(const TreeJob& job, int64_t level) {
  return (job.pulses + job.sizes[level] - 1) / job.sizes[level];
}

// Index of the first node count of a level in TreeTile.nodes.
static inline int64_t first_of_level(const TreeJob& job, int64_t level) {
  int64_t at = 0;
  for (int64_t below = 0; below < level; below++) at += 2 * subapertures(job, below);
  return at;
}

// Middle pulse of a subaperture, c of (3).
static inline int64_t middle_of(const TreeJob& job, int64_t begin, int64_t size) {
  const int64_t end = begin + size < job.pulses ? begin + size : job.pulses;
  return (begin + end - 1) / 2;
}

static inline int64_t padded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

}  // namespace apertura
