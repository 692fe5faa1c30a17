// Expansion of range profiles into tables: one short filter per polynomial coefficient and position of the cell between
// samples (docs/theory/engine.md, "Cells").
#pragma once
#include "job.hpp"
#include "lanes.hpp"

namespace {

using apertura::kTaps;

// Splits a pulse into `down` interleaved streams of re and im with zeros before and after: stream s contains samples
// s, s + down, … of the padded pulse, whose first kTaps samples are zero.
inline void split(const TableJob& job, int64_t pulse, int64_t length, float* streams) {
  const float* samples = job.samples + pulse * job.length * 2;
  for (int64_t n = 0; n < 2 * job.down * length; n++) streams[n] = 0;
  for (int64_t n = 0; n < job.length; n++) {
    const int64_t at = n + kTaps, stream = at % job.down, place = at / job.down;
    streams[(2 * stream) * length + place] = samples[2 * n];
    streams[(2 * stream + 1) * length + place] = samples[2 * n + 1];
  }
}

// Computes all coefficients a_m of (2), including the carrier, for one position of the cell between samples; result
// (2 (degree + 1), steps).
template <int64_t kCoefficients>
inline void filter(const TableJob& job, int64_t pulse, int64_t position, int64_t length, const float* streams,
                   float* result) {
  const float* carrier = job.carrier + position * job.steps * 2;
  const float* taps = job.taps + position * kCoefficients * kTaps;
  const float turn_re = job.turn[2 * pulse], turn_im = job.turn[2 * pulse + 1];
  for (int64_t m = 0; m < job.steps; m += kLanes) {
    // Each coefficient is a real filter of the complex samples about the cell.
    Lanes re[kCoefficients]{}, im[kCoefficients]{};
    for (int64_t tap = 0; tap < kTaps; tap++) {
      const int64_t at = job.lead[position] + tap + kTaps, stream = at % job.down, place = at / job.down + m;
      const Lanes x = load(streams + 2 * stream * length + place),
                  y = load(streams + (2 * stream + 1) * length + place);
      for (int64_t k = 0; k < kCoefficients; k++) {
        re[k] += taps[k * kTaps + tap] * x;
        im[k] += taps[k * kTaps + tap] * y;
      }
    }
    // exp(j k R_i) at the centre of the cell: the carrier of the pulse's first cell times that of the cell number.
    const Lanes base_re = load(carrier + m), base_im = load(carrier + job.steps + m);
    const Lanes c = base_re * turn_re - base_im * turn_im, s = base_re * turn_im + base_im * turn_re;
    for (int64_t k = 0; k < kCoefficients; k++) {
      store(result + (2 * k) * job.steps + m, re[k] * c - im[k] * s);
      store(result + (2 * k + 1) * job.steps + m, re[k] * s + im[k] * c);
    }
  }
}

template <int64_t kCoefficients>
inline void expand_all(const TableJob& job, float* scratch) {
  const int64_t length = apertura::stream_length(job), rows = 2 * kCoefficients;
  float *streams = scratch, *results = scratch + 2 * job.down * length;
  for (int64_t pulse = 0; pulse < job.pulses; pulse++) {
    split(job, pulse, length, streams);
    for (int64_t position = 0; position < job.up; position++)
      filter<kCoefficients>(job, pulse, position, length, streams, results + position * rows * job.steps);
    // The cells of all positions interleave: cell number = step * up + position.
    float* cells = job.cells + pulse * rows * job.width + job.margin;
    for (int64_t row = 0; row < rows; row++)
      for (int64_t position = 0; position < job.up; position++) {
        const float* from = results + (position * rows + row) * job.steps;
        for (int64_t m = 0, to = position; to < job.used; m++, to += job.up) cells[row * job.width + to] = from[m];
      }
  }
}

inline void expand(const TableJob& job, float* scratch) {
  job.degree == 2 ? expand_all<3>(job, scratch) : expand_all<2>(job, scratch);
}

}  // namespace
