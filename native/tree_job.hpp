// What Python hands over for a subaperture tree: one chunk of pulses on some tiles of pixels. Mirrored, field by field,
// in `core/backprojection/engines/native_binding.py`; contract.cpp lists the layout. docs/theory/tree.md derives what
// is computed.
#pragma once
#include <cstdint>

#include "job.hpp"

namespace apertura {

constexpr int64_t kTreeNodes = 128;    // along one axis of a tile, at most
constexpr int64_t kTreeSide = 256;     // pixels along a tile, at most
constexpr int64_t kTreeLevels = 4;     // at most
constexpr int64_t kTreeGroup = 64;     // pulses of a leaf, which are taken the same way
constexpr int64_t kTreeDelays = 12;    // taps of the filter that aligns a pulse to a tile
constexpr int64_t kTreeFewer = 28;     // that may stand for those of a leaf, at most
constexpr int64_t kTreeCurves = 4;     // smooth curves that the pulses of a leaf may follow
constexpr int64_t kTreeTerms = 21;     // of the track over a leaf, one more than the degree of the last of them
constexpr int64_t kTreeMore = 4;       // pulses that a curve takes beyond its degree
constexpr int64_t kTreeSlots = 136;    // 0 … kTreeNodes: that many nodes; above: pixels of one of the sides of tiles
constexpr int64_t kTreeDegree = 6;     // of a tile's surface, at most
constexpr int64_t kTreeWeights = 16;   // of the antennas' polynomial over a tile: ξ^a η^b at 4 b + a, a and b up to 3
constexpr int64_t kTreeMargin = 2;     // samples around those that a tile's paths reach
constexpr double kTreeWeighted = 1.5;  // rad that smooth weights add to the band at a tile's nodes

// How a group of pulses is taken over a tile.
enum TreeWay : uint8_t { kByTree, kDirectly, kSilently };

}  // namespace apertura

struct TreeTile {
  const double* surface;  // (degree + 1 along η, degree + 1 along ξ, 3): Legendre coefficients of the pixels' places
  const double* pixels;   // its first one; rows are TreeJob.stride pixels apart
  float* image;           // the same, (re, im)
  float* weight;          // (pulse, kTreeWeights): gain of both antennas over the tile, set by the plan; null: no beams
  uint8_t* way;           // (group): TreeWay; those not kByTree on entry are left
  uint8_t* nodes;         // (subaperture of each level in turn, 2): nodes along ξ and η
  uint8_t* fewer;         // (leaf): how many pulses stand for those of a leaf; 0: each for itself; zero on entry
  uint8_t* edge;          // (leaf): 1 where the sector ends within the tile; zero on entry
  float* slope;           // (leaf, 3): there, how much depth changes along ξ, η and the leaf's pulses, per half of them
  double centre[3];
  double rest;        // mean square of the pixels' distances from the surface; set by apertura_rest_tree
  double first_path;  // of the first sample, more than that of the centre; set by the plan
  int64_t degree, rows, columns, row_slot, column_slot;
  int64_t samples;  // of each pulse over the tile; set by the plan
  int64_t top;      // level at which pixels are formed; -1: no tree holds this tile
};

struct TreeJob {
  const float* samples;       // (pulse, length, 2)
  const double* start;        // (pulse): total path of sample 0
  const double* transmitter;  // (pulse, 3)
  const double* receiver;     // (pulse, 3)
  const float* stray;         // (leaf): metres by which pulses leave the parabola through three of them
  const float* rough;         // (leaf, kTreeCurves): and smooth curves of growing degree, RMS
  const double* track;  // (leaf, antenna, kTreeTerms, 3): its phase centres as polynomials, orthonormal over the leaf
  const float* taps;    // (taps_count, up, 2, 2): of level and slope, each twice (for re, im)
  const float* delay;   // (delay_terms, kTreeDelays): polynomials of the fraction of a sample
  const float* const* presum;   // (kTreeFewer + 1): weights (fewer, pulse of a leaf)
  const double* const* curve;   // (kTreeFewer + 1): the polynomials of `track` at (fewer, kTreeTerms)
  const double* supports;       // (kTreeNodes + 1): band that so many nodes hold, rad per half tile
  const double* const* places;  // (kTreeSlots): nodes or pixels along an axis, -1 … 1
  const float* const* spread;   // (kTreeNodes + 1, kTreeSlots): (node, 2 padded): weights, each twice
  const float* const* mix;      // (kTreeNodes + 1, kTreeSlots): (target, node): the same weights
  TreeTile* tiles;
  int64_t pulses, length, up, lead, stride, count, levels, mono, phase_polynomial;
  int64_t taps_count, delay_terms;
  int64_t sizes[apertura::kTreeLevels];  // pulses of a subaperture
  double step, wavenumber, band;         // metres; 2 pi f / c; half the band in the same unit
  double smooth;                         // rad that pulses may leave a smooth curve by, RMS, to be made fewer
  double node_error;                     // that one interpolation between nodes may make, RMS, relative
  const BeamJob* beam[2];                // as of ApertureJob, their axes `pulses` apart
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

// The pulse that stands for a subaperture.
static inline int64_t middle_of(const TreeJob& job, int64_t begin, int64_t size) {
  const int64_t end = begin + size < job.pulses ? begin + size : job.pulses;
  return (begin + end - 1) / 2;
}

static inline int64_t padded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

}  // namespace apertura
