// What Python hands over for a subaperture tree: one chunk of pulses on some tiles of pixels. Mirrored, field by field,
// in `core/backprojection/engines/native_binding.py`; contract.cpp lists the layout. docs/theory/tree.md derives what
// is computed.
#pragma once
#include <cstdint>

#include "job.hpp"

namespace apertura {

constexpr int64_t kTreeNodes = 128;        // along one axis of a tile, at most
constexpr int64_t kTreeSide = 256;         // pixels along a tile, at most
constexpr int64_t kTreeLevels = 4;         // at most
constexpr int64_t kTreeGroup = 64;         // pulses of a leaf, all summed by one variant
constexpr int64_t kTreeDelays = 12;        // taps of the filter that aligns a pulse to a tile
constexpr int64_t kTreeMostVirtual = 28;   // virtual (presummed) pulses that replace those of a leaf, at most
constexpr int64_t kTreeCurves = 4;         // degrees of the curve through a leaf's track that are tried
constexpr int64_t kTreeTerms = 21;         // of the track over a leaf, one more than the degree of the last of them
constexpr int64_t kTreeVirtualMargin = 4;  // virtual pulses of a curve beyond its degree
constexpr int64_t kTreeSlots = 136;    // 0 … kTreeNodes: that many nodes; above: pixels of one of the sides of tiles
constexpr int64_t kTreeDegree = 6;     // of a tile's surface, at most
constexpr int64_t kTreeWeights = 16;   // of the antennas' polynomial over a tile: ξ^a η^b at 4 b + a, a and b up to 3
constexpr int64_t kTreeMargin = 2;     // samples around those that a tile's paths reach
constexpr double kTreeWeighted = 1.5;  // rad that smooth weights add to the band at a tile's nodes

// Variant by which a group of pulses is summed over a tile; kNoEcho: no profile, weight or sector reaches the tile.
enum TreeVariant : uint8_t { kByTree, kDirectly, kNoEcho };

}  // namespace apertura

struct TreeTile {
  const double* surface;  // (degree + 1 along η, degree + 1 along ξ, 3): Legendre coefficients of the pixels' places
  const double* pixels;   // its first one; rows are TreeJob.stride pixels apart
  float* image;           // the same, (re, im)
  float* weight;          // (pulse, kTreeWeights): gain of both antennas over the tile, set by the plan; null: no beams
  uint8_t* variant;       // (group): TreeVariant; those not kByTree on entry are left
  uint8_t* nodes;         // (subaperture of each level in turn, 2): nodes along ξ and η
  // (leaf): virtual pulses that replace those of a leaf; 0: each pulse is summed itself. Between apertura_weigh_tree
  // and the plan 1 marks weights that jump from pulse to pulse, which no virtual pulse can have; zero on entry.
  uint8_t* n_virtual_pulses;
  uint8_t* edge;  // (leaf): 1 where the sector ends within the tile; zero on entry
  float* slope;   // (leaf, 3): there, how much depth changes along ξ, η and the leaf's pulses, per half of them
  float* band;  // (subaperture of each level in turn, 2): (4b) along ξ and η, rad per half tile; by apertura_view_tree
  float* turn;  // (leaf, 2): of the carrier in half a leaf, rad, and (8b) in rad per metre; by apertura_view_tree
  double centre[3];
  double rest;        // mean square of the pixels' distances from the surface; set by apertura_rest_tree
  double first_path;  // of the first sample, more than that of the centre; set by the plan
  double span,
      slope_rms;  // total path across the tile, and RMS of its slope, metres per half tile; by apertura_view_tree
  int64_t degree, rows, columns, row_slot, column_slot;
  int64_t samples;  // of each pulse over the tile; set by the plan
  int64_t top;      // level at which pixels are formed; -1: no tree holds this tile
};

struct TreeJob {
  const float* samples;             // (pulse, length, 2)
  const double* start;              // (pulse): total path of sample 0
  const double* transmitter;        // (pulse, 3)
  const double* receiver;           // (pulse, 3)
  const float* max_track_residual;  // (leaf): of its pulses, metres from the parabola through three of them
  const float* rms_track_residual;  // (leaf, kTreeCurves): metres from curves of growing degree
  const double* track;  // (leaf, antenna, kTreeTerms, 3): its phase centres as polynomials, orthonormal over the leaf
  const float* taps;    // (taps_count, up, 2, 2): of level and slope, each twice (for re, im)
  const float* delay;   // (delay_terms, kTreeDelays): polynomials of the fraction of a sample
  const float* const* presum;   // (kTreeMostVirtual + 1): weights (virtual pulse, pulse of a leaf)
  const double* const* curve;   // (kTreeMostVirtual + 1): polynomials of `track` at (virtual pulse, kTreeTerms)
  const double* supports;       // (kTreeNodes + 1): band that so many nodes hold, rad per half tile
  const double* const* places;  // (kTreeSlots): nodes or pixels along an axis, -1 … 1
  const float* const* spread;   // (kTreeNodes + 1, kTreeSlots): (node, 2 padded): weights, each twice
  const float* const* mix;      // (kTreeNodes + 1, kTreeSlots): (target, node): the same weights
  TreeTile* tiles;
  int64_t pulses, length, up, lead, stride, count, levels, mono, phase_polynomial;
  int64_t taps_count, delay_terms;
  int64_t sizes[apertura::kTreeLevels];  // pulses of a subaperture
  int64_t curve_degrees[apertura::kTreeCurves];
  double step, wavenumber, band;  // metres; 2 pi f / c; half the band in the same unit
  double presum_error;            // tolerated (8b), rad RMS
  double node_error;              // that one interpolation between nodes may make, RMS, relative
  const BeamJob* beam[2];         // as of ApertureJob, their axes `pulses` apart
  const SectorJob* sector;
  float phase_coefficients[9];
};

namespace apertura {

static inline int64_t subapertures(const TreeJob& job, int64_t level) {
  return (job.pulses + job.sizes[level] - 1) / job.sizes[level];
}

// Where the node counts of a level begin in TreeTile.nodes.
static inline int64_t first_of_level(const TreeJob& job, int64_t level) {
  int64_t at = 0;
  for (int64_t below = 0; below < level; below++) at += 2 * subapertures(job, below);
  return at;
}

// The middle pulse of a subaperture, c of (3).
static inline int64_t middle_of(const TreeJob& job, int64_t begin, int64_t size) {
  const int64_t end = begin + size < job.pulses ? begin + size : job.pulses;
  return (begin + end - 1) / 2;
}

static inline int64_t padded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

}  // namespace apertura
