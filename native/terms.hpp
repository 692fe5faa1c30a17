// Contribution of each pulse at each point in float64, by a long windowed sinc: the reference for certificates of the
// engines, docs/theory.md (6). Without a compiled library, numpy computes the same values.
#pragma once
#include "bounds.hpp"
#include "job.hpp"

namespace {

using apertura::kTermTaps;

constexpr int64_t kGroup = 8;  // floats: re and im of four samples
typedef double Doubles __attribute__((vector_size(8 * kGroup), aligned(8), may_alias));
typedef float Floats __attribute__((vector_size(4 * kGroup), aligned(4), may_alias));

// Interpolates the profile between its samples, with weights linear between two neighbouring rows of `weights`.
inline void interpolate(const float* samples, const double* weights, double fraction, double& re, double& im) {
  static_assert(2 * kTermTaps % kGroup == 0, "whole groups");
  Doubles sum{};
  for (int64_t t = 0; t < 2 * kTermTaps; t += kGroup) {
    const Doubles here = *reinterpret_cast<const Doubles*>(weights + t);
    const Doubles next = *reinterpret_cast<const Doubles*>(weights + 2 * kTermTaps + t);
    const Floats some = *reinterpret_cast<const Floats*>(samples + t);
    sum += (here + fraction * (next - here)) * __builtin_convertvector(some, Doubles);
  }
  re = (sum[0] + sum[2]) + (sum[4] + sum[6]), im = (sum[1] + sum[3]) + (sum[5] + sum[7]);
}

inline double distance(const double* from, const double* to) {
  const double x = to[0] - from[0], y = to[1] - from[1], z = to[2] - from[2];
  return __builtin_sqrt(x * x + y * y + z * z);
}

inline void add_terms(const TermsJob& job) {
  for (int64_t pulse = 0; pulse < job.pulses; pulse++)
    for (int64_t n = 0; n < job.count; n++) {
      double* term = job.terms + 2 * (pulse * job.count + n);
      const double* place = job.pixels + 3 * n;
      const double path = distance(job.transmitter + 3 * pulse, place) + distance(job.receiver + 3 * pulse, place);
      const double at = (path - job.start[pulse]) / job.step;
      // Samples beyond the profile are zero; the result for a non-finite point is NaN.
      if (!(at > -kTermTaps && at < double(job.length + kTermTaps))) {
        term[0] = term[1] = at == at ? 0 : at;
        continue;
      }
      const int64_t base = int64_t(__builtin_floor(at)), first = base + 1 - kTermTaps / 2;
      const double place_of_weights = (at - double(base)) * double(job.fractions);
      const int64_t row = int64_t(place_of_weights) < job.fractions ? int64_t(place_of_weights) : job.fractions - 1;
      const float* samples = job.samples + 2 * (pulse * job.length + first);
      float edge[2 * kTermTaps] = {};
      if (first < 0 || first + kTermTaps > job.length) {
        for (int64_t t = 0; t < kTermTaps; t++)
          if (first + t >= 0 && first + t < job.length)
            edge[2 * t] = samples[2 * t], edge[2 * t + 1] = samples[2 * t + 1];
        samples = edge;
      }
      double re, im;
      interpolate(samples, job.weights + 2 * kTermTaps * row, place_of_weights - double(row), re, im);
      const double turns = job.turns_per_metre * path, phase = 6.283185307179586 * (turns - __builtin_floor(turns));
      const double cosine = __builtin_cos(phase), sine = __builtin_sin(phase);
      term[0] = re * cosine - im * sine, term[1] = re * sine + im * cosine;
    }
}

}  // namespace
