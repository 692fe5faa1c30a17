// What pulses add at single places, and how that changes with the path: no tables, no series. For places that are few,
// such as those around bright points. docs/theory/autofocus.md, "What pulses add", has the equations.
#pragma once
#include "bounds.hpp"
#include "job.hpp"

namespace {

using apertura::kEchoDegree;
using apertura::kEchoTaps;

constexpr int64_t kRun = 64;                   // pulses whose paths to a place are taken together
constexpr double kWhole = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to the nearest integer
typedef float Taps __attribute__((vector_size(4 * kEchoTaps), may_alias));
typedef float UnalignedTaps __attribute__((vector_size(4 * kEchoTaps), aligned(4), may_alias));

inline Taps load_taps(const float* from) { return *reinterpret_cast<const UnalignedTaps*>(from); }
inline float total(Taps value) {
  static_assert(kEchoTaps == 8, "three halvings");
  const float a = value[0] + value[4], b = value[1] + value[5], c = value[2] + value[6], d = value[3] + value[7];
  return (a + c) + (b + d);
}

// Where a place lies in the samples of up to kRun pulses.
struct Looks {
  alignas(64) float u[kRun];                   // from the middle between the two nearest samples, in samples
  alignas(64) float cosine[kRun], sine[kRun];  // of the carrier's phase, times the pulse's weight
  alignas(64) int32_t first[kRun];             // first sample that takes part
};

// Distance of a place from an antenna at pulse q.
inline double leg(const double* antenna, int64_t pulses, int64_t q, const double* place) {
  const double x = place[0] - antenna[q], y = place[1] - antenna[pulses + q], z = place[2] - antenna[2 * pulses + q];
  return __builtin_sqrt(x * x + y * y + z * z);
}

// The sine of pi t and the cosine for |t| <= 1/2, by Taylor to below the rounding of float.
inline void half_turns(float t, float& cosine, float& sine) {
  const float x = 3.14159265358979f * t, z = x * x;
  sine = x * (1 + z * (-1.f / 6 + z * (1.f / 120 + z * (-1.f / 5040 + z * (1.f / 362880 + z * (-1.f / 39916800))))));
  cosine =
      1 + z * (-1.f / 2 +
               z * (1.f / 24 + z * (-1.f / 720 + z * (1.f / 40320 + z * (-1.f / 3628800 + z * (1.f / 479001600))))));
}

// Looks at one place from pulses begin .. begin + count.
inline void look(const EchoJob& job, int64_t pixel, int64_t begin, int64_t count, Looks& looks) {
  const double* place = job.pixels + 3 * pixel;
  const float* weight = job.weight + pixel * job.weight_step + begin;
  // Held inside the samples; what lies beyond them is held where only zeros are.
  const double low = kEchoTaps / 2 - 0.5, high = double(job.length) - kEchoTaps / 2 - 0.5;
  const double *tx = job.transmitter + begin, *rx = job.receiver + begin, *start = job.start + begin;
  for (int64_t i = 0; i < count; i++) {
    const double path = leg(tx, job.pulses, i, place) + leg(rx, job.pulses, i, place);
    double at = (path - start[i]) * job.samples_per_metre;
    at = at > low ? at : low;
    at = at < high ? at : high;
    const double whole = (at - 0.5 + kWhole) - kWhole;
    looks.first[i] = int32_t(whole) - int32_t(kEchoTaps / 2 - 1);
    looks.u[i] = float(at - 0.5 - whole);
    // Whole turns go in float64; of the rest, by the double angle.
    const double turns = path * job.turns_per_metre;
    float cosine, sine;
    half_turns(float(turns - ((turns + kWhole) - kWhole)), cosine, sine);
    looks.cosine[i] = weight[i] * (1 - 2 * sine * sine);
    looks.sine[i] = weight[i] * (2 * sine * cosine);
  }
}

// Weights of the samples about a place between two of them: each a polynomial of where it is.
struct Weights {
  Taps coefficient[kEchoDegree + 1];
  explicit Weights(const float* taps) {
    for (int64_t n = 0; n <= kEchoDegree; n++) coefficient[n] = load_taps(taps + n * kEchoTaps);
  }
  Taps operator()(float u) const {
    Taps value = coefficient[kEchoDegree];
    for (int64_t n = kEchoDegree - 1; n >= 0; n--) value = value * u + coefficient[n];
    return value;
  }
  // Their derivative, per sample.
  Taps slope(float u) const {
    Taps value = float(kEchoDegree) * coefficient[kEchoDegree];
    for (int64_t n = kEchoDegree - 1; n >= 1; n--) value = value * u + float(n) * coefficient[n];
    return value;
  }
};

// Adds some pulses of a run to the sum of a block: s(R) exp(j k R), re and im.
inline void add_looks(const EchoJob& job, const Weights& weights, const Looks& looks, int64_t run, int64_t begin,
                      int64_t end, float* sum) {
  Taps re{}, im{};
  for (int64_t i = begin; i < end; i++) {
    const float* row = job.samples + (run + i) * 2 * job.length + looks.first[i];
    const Taps weight = weights(looks.u[i]), c = weight * looks.cosine[i], s = weight * looks.sine[i];
    const Taps sr = load_taps(row), si = load_taps(row + job.length);
    re += c * sr - s * si, im += c * si + s * sr;
  }
  sum[0] += total(re), sum[1] += total(im);
}

inline void contribute(const EchoJob& job) {
  const Weights weights(job.taps);
  Looks looks;
  int64_t first_block = 0;
  for (int64_t run = 0; run < job.pulses; run += kRun) {
    const int64_t end = run + kRun < job.pulses ? run + kRun : job.pulses;
    while (job.edges[first_block + 1] <= run) first_block++;
    for (int64_t pixel = 0; pixel < job.count; pixel++) {
      look(job, pixel, run, end - run, looks);
      for (int64_t b = first_block; b < job.blocks && job.edges[b] < end; b++) {
        const int64_t from = job.edges[b] > run ? job.edges[b] - run : 0;
        const int64_t to = job.edges[b + 1] < end ? job.edges[b + 1] - run : end - run;
        add_looks(job, weights, looks, run, from, to, job.sums + 2 * (pixel * job.width + job.columns[b]));
      }
    }
  }
}

// (7): what the objective gains at one pixel per metre that the path of each pulse of a run grows.
inline void path_slopes(const EchoJob& job, const Weights& weights, const Looks& looks, int64_t pixel, int64_t run,
                        int64_t count, float* slope) {
  const float re = job.objective[2 * pixel], im = job.objective[2 * pixel + 1];
  const float per_metre = float(job.samples_per_metre), wavenumber = float(6.283185307179586 * job.turns_per_metre);
  for (int64_t i = 0; i < count; i++) {
    // q = conj(G) exp(j k R); Re(q (s' + j k s)), with s and s' written out as sums over samples.
    const float qr = re * looks.cosine[i] + im * looks.sine[i], qi = re * looks.sine[i] - im * looks.cosine[i];
    const float* row = job.samples + (run + i) * 2 * job.length + looks.first[i];
    const Taps level = weights(looks.u[i]) * wavenumber, rate = weights.slope(looks.u[i]) * per_metre;
    slope[i] =
        total(load_taps(row) * (rate * qr - level * qi) - load_taps(row + job.length) * (rate * qi + level * qr));
  }
}

// (8): a phase centre that moves changes the path by the unit vector from the pixel to it.
inline void add_directions(const double* antenna, int64_t pulses, int64_t count, const double* place,
                           const float* slope, double (*sum)[kRun]) {
  for (int64_t i = 0; i < count; i++) {
    const double x = antenna[i] - place[0], y = antenna[pulses + i] - place[1], z = antenna[2 * pulses + i] - place[2];
    const double share = slope[i] / __builtin_sqrt(x * x + y * y + z * z);
    sum[0][i] += share * x, sum[1][i] += share * y, sum[2][i] += share * z;
  }
}

inline void differentiate(const EchoJob& job) {
  const Weights weights(job.taps);
  Looks looks;
  alignas(64) float slope[kRun];
  for (int64_t run = 0; run < job.pulses; run += kRun) {
    const int64_t count = job.pulses - run < kRun ? job.pulses - run : kRun;
    alignas(64) double sum[7][kRun] = {};
    for (int64_t pixel = 0; pixel < job.count; pixel++) {
      const double* place = job.pixels + 3 * pixel;
      look(job, pixel, run, count, looks);
      path_slopes(job, weights, looks, pixel, run, count, slope);
      add_directions(job.transmitter + run, job.pulses, count, place, slope, sum);
      add_directions(job.receiver + run, job.pulses, count, place, slope, sum + 3);
      // Echoes that lie further are looked for as if the path were shorter.
      for (int64_t i = 0; i < count; i++) sum[6][i] -= slope[i];
    }
    for (int64_t axis = 0; axis < 7; axis++)
      for (int64_t i = 0; i < count; i++) job.slopes[axis * job.pulses + run + i] += sum[axis][i];
  }
}

}  // namespace
