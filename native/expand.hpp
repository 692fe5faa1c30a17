// Range profiles to tables: one short filter per polynomial coefficient and position of the cell between samples.
#pragma once
#include "job.hpp"
#include "lanes.hpp"

namespace {

constexpr int kTaps = 16;

// Splits a pulse into `down` interleaved streams of re and im, zeros before and after: stream s holds samples
// s, s + down, … of the padded pulse, whose first `lead` samples are zero.
inline void split(const TableJob& job, int64_t pulse, int64_t room, float* streams) {
  const float* samples = job.samples + pulse * job.length * 2;
  for (int64_t n = 0; n < 2 * job.down * room; n++) streams[n] = 0;
  for (int64_t n = 0; n < job.length; n++) {
    const int64_t at = n + kTaps, stream = at % job.down, place = at / job.down;
    streams[(2 * stream) * room + place] = samples[2 * n];
    streams[(2 * stream + 1) * room + place] = samples[2 * n + 1];
  }
}

// One position of the cell: all coefficients, carrier folded in; result (2 (degree + 1), steps).
template <int kCoefficients>
inline void filter(const TableJob& job, int64_t pulse, int64_t position, int64_t room, const float* streams,
                   float* result) {
  const float* carrier = job.carrier + position * job.steps * 2;
  const float* taps = job.taps + position * kCoefficients * kTaps;
  const float turn_re = job.turn[2 * pulse], turn_im = job.turn[2 * pulse + 1];
  for (int64_t m = 0; m < job.steps; m += kLanes) {
    Lanes re[kCoefficients]{}, im[kCoefficients]{};
    for (int tap = 0; tap < kTaps; tap++) {
      const int64_t at = job.lead[position] + tap + kTaps, stream = at % job.down, place = at / job.down + m;
      const Lanes x = load(streams + 2 * stream * room + place), y = load(streams + (2 * stream + 1) * room + place);
      for (int k = 0; k < kCoefficients; k++) {
        re[k] += taps[k * kTaps + tap] * x;
        im[k] += taps[k * kTaps + tap] * y;
      }
    }
    const Lanes base_re = load(carrier + m), base_im = load(carrier + job.steps + m);
    const Lanes c = base_re * turn_re - base_im * turn_im, s = base_re * turn_im + base_im * turn_re;
    for (int k = 0; k < kCoefficients; k++) {
      store(result + (2 * k) * job.steps + m, re[k] * c - im[k] * s);
      store(result + (2 * k + 1) * job.steps + m, re[k] * s + im[k] * c);
    }
  }
}

template <int kCoefficients>
inline void expand_all(const TableJob& job, float* scratch) {
  const int64_t room = job.steps + 3 * kTaps, rows = 2 * kCoefficients;
  float *streams = scratch, *results = scratch + 2 * job.down * room;
  for (int64_t pulse = 0; pulse < job.pulses; pulse++) {
    split(job, pulse, room, streams);
    for (int64_t position = 0; position < job.up; position++)
      filter<kCoefficients>(job, pulse, position, room, streams, results + position * rows * job.steps);
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
