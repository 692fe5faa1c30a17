// What Python hands over. `core/backprojection/engines/native_binding.py` mirrors these structs field by field and
// compares the two layouts when it loads the library (contract.cpp lists them).
#pragma once
#include <cstdint>

#include "bounds.hpp"

// The beam of one antenna: gain over azimuth times gain over elevation, about axes that may turn with each pulse.
struct BeamJob {
  const double* axes;    // (3 axes, 3, padded): unit vectors of boresight, growing azimuth, growing elevation
  const float* gain[2];  // over azimuth and over elevation
  int64_t count[2];      // samples of each, at least 2
  double first_rad[2], samples_per_rad[2];
  double peak;  // largest |gain| of the product
};

// The sector that pixels are integrated over, docs/theory/integration.md (1), (3) and (4).
struct SectorJob {
  const double* axis[2];               // of transmitter and receiver, (3, padded)
  double centre, inner, outer;         // of s; from `inner` to `outer` off the centre the weight falls from 1 to 0
  const double *end[2], *end_axis[2];  // (ends, 3): pulses between which all was flown, and their axes
  int64_t ends;                        // 0: the sector of every pixel is about `centre`
};

// A tile of pixels to be formed from tables. Lengths in metres unless they say "cells".
struct ApertureJob {
  const float* cells;         // (pulse, 2 (degree + 1), width): re, im of each polynomial coefficient
  const double* transmitter;  // (3, padded): pulses padded to a multiple of kBatch by repeating the last
  const double* receiver;     // (3, padded)
  const double* first_path;   // (padded): total path of the middle of cell 0
  const double* pixels;       // (rows, columns, 3)
  float* image;               // (rows, columns, 2): re, im
  int64_t* counts;            // pulses x patches that took: shared curvature, own curvature, exact path, none
  int64_t pulses, padded, width, rows, columns;
  double cells_per_metre;
  double radians_per_cell;      // carrier phase over one cell
  double tolerance_rad;         // largest phase error of the geometry that the series may make
  int32_t degree;               // of the polynomials: 1 or 2
  int32_t phase_polynomial;     // index into phase.hpp
  int32_t wide_sum;             // 1: sums over pulses in float64
  float phase_coefficients[9];  // cosine (4), sine (4), half turns per cell
  const BeamJob* beam[2];       // of transmitter and receiver; null: the same in all directions
  const SectorJob* sector;      // null: every pulse counts everywhere
};

// Range profiles to be turned into tables.
struct TableJob {
  const float* samples;  // (pulse, length, 2)
  const float* taps;     // (up, degree + 1, kTaps): real filters, see native_tables.py
  const int32_t* lead;   // (up): sample at which the first tap of position 0 lies
  const float* carrier;  // (up, 2, steps): re, im of exp(j carrier) at each cell relative to cell `margin`
  const float* turn;     // (pulse, 2): exp(j carrier) of cell `margin`
  float* cells;          // (pulse, 2 (degree + 1), width), zero on entry
  int64_t pulses, length, width, up, down, steps, margin, used;
  int32_t degree;
};

// What single pulses add at single places, blocks of pulses apart.
struct EchoJob {
  const float* samples;       // (pulse, 2, length): re, im, with kEchoTaps zeros at both ends
  const float* taps;          // (kEchoDegree + 1, kEchoTaps): of each sample's weight, constant term first
  const double* transmitter;  // (3, pulses)
  const double* receiver;     // (3, pulses)
  const double* start;        // (pulses): total path of sample 0, a zero
  const float* weight;        // (pulses), or (count, pulses)
  const double* pixels;       // (count, 3)
  const int64_t* edges;       // (blocks + 1): pulses edges[b] .. edges[b + 1] are added to columns[b]
  const int64_t* columns;     // (blocks)
  float* sums;                // (count, width, 2): re, im, to be added to
  const float* objective;     // (count, 2): re, im of what an objective gains per change of the sum at a pixel
  double* slopes;             // (7, pulses), to be added to: of transmitter (3), receiver (3) and path
  int64_t pulses, length, count, blocks, width;
  int64_t weight_step;  // from one pixel's weights to the next: 0 or pulses
  double samples_per_metre, turns_per_metre;
};

// What each pulse adds at each place, in float64.
struct TermsJob {
  const float* samples;   // (pulse, length, 2): re, im
  const double* weights;  // (fractions + 1, kTermTaps, 2): of the samples about a place so far behind one, twice each
  const double* transmitter;  // (pulse, 3)
  const double* receiver;     // (pulse, 3)
  const double* start;        // (pulse): total path of sample 0
  const double* pixels;       // (count, 3)
  double* terms;              // (pulse, count, 2): re, im
  int64_t pulses, length, count, fractions;
  double step, turns_per_metre;
};

// Static: compiled for several instruction sets, whose copies the linker must never merge.
namespace apertura {

// Samples of one of the `down` streams into which a pulse is split, with the zeros around them.
static inline int64_t stream_length(const TableJob& job) { return job.steps + 3 * kTaps; }

// Floats of scratch that a TableJob needs: the streams, and the cells of one pulse before they are interleaved.
static inline int64_t scratch_length(const TableJob& job) {
  return 2 * job.down * stream_length(job) + job.up * 2 * (job.degree + 1) * job.steps;
}

}  // namespace apertura
