// Contributions of pulses at single points, and their derivatives with the path, without tables or series; for small
// numbers of points such as the surroundings of bright points. Equations: docs/theory/autofocus.md, "What pulses add".
#pragma once
#include "bounds.hpp"
#include "job.hpp"

namespace {

using apertura::kEchoDegree;
using apertura::kEchoTaps;

constexpr int64_t kRun = 64;                   // pulses whose paths to a point are computed together
constexpr double kWhole = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to the nearest integer
typedef float Taps __attribute__((vector_size(4 * kEchoTaps), may_alias));
typedef float UnalignedTaps __attribute__((vector_size(4 * kEchoTaps), aligned(4), may_alias));

inline Taps load_taps(const float* from) { return *reinterpret_cast<const UnalignedTaps*>(from); }
inline float total(Taps value) {
  static_assert(kEchoTaps == 8, "three halvings");
  const float a = value[0] + value[4], b = value[1] + value[5], c = value[2] + value[6], d = value[3] + value[7];
  return (a + c) + (b + d);
}

// Position of a point in the samples of up to kRun pulses.
struct Looks {
  alignas(64) float u[kRun];                   // offset from the midpoint between the two nearest samples, in samples
  alignas(64) float cosine[kRun], sine[kRun];  // of the carrier phase, times the weight of the pulse
  alignas(64) int32_t first[kRun];             // first sample of the interpolation
};

// Distance of a point from an antenna at pulse q.
inline double leg(const double* antenna, int64_t pulses, int64_t q, const double* place) {
  const double x = place[0] - antenna[q], y = place[1] - antenna[pulses + q], z = place[2] - antenna[2 * pulses + q];
  return __builtin_sqrt(x * x + y * y + z * z);
}

// Sine and cosine of pi t for |t| <= 1/2, by Taylor series with errors below the rounding of float.
inline void half_turns(float t, float& cosine, float& sine) {
  const float x = 3.14159265358979f * t, z = x * x;
  sine = x * (1 + z * (-1.f / 6 + z * (1.f / 120 + z * (-1.f / 5040 + z * (1.f / 362880 + z * (-1.f / 39916800))))));
  cosine =
      1 + z * (-1.f / 2 +
               z * (1.f / 24 + z * (-1.f / 720 + z * (1.f / 40320 + z * (-1.f / 3628800 + z * (1.f / 479001600))))));
}

// Computes the positions of one point in the samples of pulses begin .. begin + count.
inline void look(const EchoJob& job, int64_t pixel, int64_t begin, int64_t count, Looks& looks) {
  const double* place = job.pixels + 3 * pixel;
  const float* weight = job.weight + pixel * job.weight_step + begin;
  // Positions are clamped to the samples; those beyond are clamped to where the samples are zero.
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
    // Integer cycles are removed in float64; the phase of the remainder follows from the half angle.
    const double turns = path * job.turns_per_metre;
    float cosine, sine;
    half_turns(float(turns - ((turns + kWhole) - kWhole)), cosine, sine);
    looks.cosine[i] = weight[i] * (1 - 2 * sine * sine);
    looks.sine[i] = weight[i] * (2 * sine * cosine);
  }
}

// Interpolation weights of the samples about a position: each is a polynomial of the position.
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
  // Derivatives of the weights, per sample.
  Taps slope(float u) const {
    Taps value = float(kEchoDegree) * coefficient[kEchoDegree];
    for (int64_t n = kEchoDegree - 1; n >= 1; n--) value = value * u + float(n) * coefficient[n];
    return value;
  }
};

// Adds pulses begin .. end of a run to the sum of a block: s(R) exp(j k R), re and im.
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

// (7): derivative of the objective at one pixel with respect to the path of each pulse of a run, per metre.
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

// (8): the gradient of the path with respect to a phase centre is the unit vector from the pixel to it.
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
      // An additional path of the echoes has the opposite sign: their positions are computed with a shorter path.
      for (int64_t i = 0; i < count; i++) sum[6][i] -= slope[i];
    }
    for (int64_t axis = 0; axis < 7; axis++)
      for (int64_t i = 0; i < count; i++) job.slopes[axis * job.pulses + run + i] += sum[axis][i];
  }
}

}  // namespace
