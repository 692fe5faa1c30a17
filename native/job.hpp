// Structs passed from Python. `core/backprojection/engines/native_binding.py` mirrors them field by field and compares
// both layouts when it loads the library (contract.cpp lists them).
#pragma once
#include <cstdint>

#include "bounds.hpp"

// Beam of one antenna: gain over azimuth times gain over elevation, about axes that may rotate from pulse to pulse.
struct BeamJob {
  const double* axes;    // (3 axes, 3, padded): unit vectors of boresight, increasing azimuth, increasing elevation
  const float* gain[2];  // over azimuth and over elevation
  int64_t count[2];      // samples of each, at least 2
  double first_rad[2], samples_per_rad[2];
  double peak;  // largest |gain| of the product
};

// Integration sector of the pixels, docs/theory/integration.md (1), (3) and (4).
struct SectorJob {
  const double* axis[2];               // of transmitter and receiver, (3, padded)
  double centre, inner, outer;         // of s; the weight is 1 up to `inner` from the centre and 0 from `outer` on
  const double *end[2], *end_axis[2];  // (ends, 3): phase centres at the ends of the flight, and their axes
  int64_t ends;                        // 0: the sector of every pixel is centred on `centre`
};

// Tile of pixels to be formed from tables. Lengths are in metres, except where cells are stated.
struct ApertureJob {
  const float* cells;         // (pulse, 2 (degree + 1), width): re, im of each polynomial coefficient
  const double* transmitter;  // (3, padded): pulses padded to a multiple of kBatch by repeating the last
  const double* receiver;     // (3, padded)
  const double* first_path;   // (padded): total path at the centre of cell 0
  const double* pixels;       // (rows, columns, 3)
  float* image;               // (rows, columns, 2): re, im
  int64_t* counts;            // pulses x patches by path variant: shared curvature, own curvature, exact path, none
  int64_t pulses, padded, width, rows, columns;
  double cells_per_metre;
  double radians_per_cell;      // carrier phase over one cell
  double tolerance_rad;         // tolerated phase error of the series
  int32_t degree;               // of the polynomials: 1 or 2
  int32_t phase_polynomial;     // index into phase.hpp
  int32_t wide_sum;             // 1: sums over pulses in float64
  float phase_coefficients[9];  // cosine (4), sine (4), half turns per cell
  const BeamJob* beam[2];       // of transmitter and receiver; null: isotropic
  const SectorJob* sector;      // null: every pulse contributes to every pixel
};

// Range profiles to be expanded into tables.
struct TableJob {
  const float* samples;  // (pulse, length, 2)
  const float* taps;     // (up, degree + 1, kTaps): real filters, see native_tables.py
  const int32_t* lead;   // (up): sample of the first tap of each position, for its first cell
  const float* carrier;  // (up, 2, steps): re, im of exp(j carrier) at each cell relative to cell `margin`
  const float* turn;     // (pulse, 2): exp(j carrier) of cell `margin`
  float* cells;          // (pulse, 2 (degree + 1), width), zero on entry
  int64_t pulses, length, width, up, down, steps, margin, used;
  int32_t degree;
};

// Contributions of pulses at single points, summed separately over blocks of pulses.
struct EchoJob {
  const float* samples;       // (pulse, 2, length): re, im, with kEchoTaps zeros at both ends
  const float* taps;          // (kEchoDegree + 1, kEchoTaps): polynomial of each sample's weight, constant term first
  const double* transmitter;  // (3, pulses)
  const double* receiver;     // (3, pulses)
  const double* start;        // (pulses): total path of sample 0, which is zero
  const float* weight;        // (pulses), or (count, pulses)
  const double* pixels;       // (count, 3)
  const int64_t* edges;       // (blocks + 1): pulses edges[b] .. edges[b + 1] are added to columns[b]
  const int64_t* columns;     // (blocks)
  float* sums;                // (count, width, 2): re, im; contributions are added
  const float* objective;     // (count, 2): re, im of the derivative of an objective with respect to a pixel's sum
  double* slopes;             // (7, pulses): gradients for transmitter (3), receiver (3) and path; results are added
  int64_t pulses, length, count, blocks, width;
  int64_t weight_step;  // stride from one pixel's weights to the next: 0 or pulses
  double samples_per_metre, turns_per_metre;
};

// Contribution of each pulse at each point, in float64.
struct TermsJob {
  const float* samples;   // (pulse, length, 2): re, im
  const double* weights;  // (fractions + 1, kTermTaps, 2): interpolation weights by fraction of a sample, each twice
  const double* transmitter;  // (pulse, 3)
  const double* receiver;     // (pulse, 3)
  const double* start;        // (pulse): total path of sample 0
  const double* pixels;       // (count, 3)
  double* terms;              // (pulse, count, 2): re, im
  int64_t pulses, length, count, fractions;
  double step, turns_per_metre;
};

// Functions are static: they are compiled for several instruction sets, and the linker must never merge the copies.
namespace apertura {

// Length of one of the `down` streams into which a pulse is split, including the zeros around it.
static inline int64_t stream_length(const TableJob& job) { return job.steps + 3 * kTaps; }

// Scratch floats of a TableJob: the streams, and the cells of one pulse before interleaving.
static inline int64_t scratch_length(const TableJob& job) {
  return 2 * job.down * stream_length(job) + job.up * 2 * (job.degree + 1) * job.steps;
}

}  // namespace apertura
