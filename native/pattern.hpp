// Gain of an antenna in a direction: product of two sampled cuts, linear between samples and zero beyond them.
// docs/theory/engine.md, "Antennas" (6).
#pragma once
#include "job.hpp"
#include "lanes.hpp"

namespace {

// atan2 with an error of 1e-7 rad, without branches: odd polynomial of the smaller ratio, then octants.
inline float angle(float y, float x) {
  const float a = magnitude(x), b = magnitude(y);
  const float z = (a < b ? a : b) / ((a < b ? b : a) + 1e-30f), s = z * z;
  const float high = -0.13908629f + s * (0.09642196f + s * (-0.05591232f + s * (0.02186295f + s * -0.00405457f)));
  float turn = z * (0.99999934f + s * (-0.33329861f + s * (0.19946566f + s * high)));
  turn = b > a ? 1.57079633f - turn : turn;
  turn = x < 0 ? 3.14159265f - turn : turn;
  return y < 0 ? -turn : turn;
}

// Position in the azimuth (0) or elevation (1) cut of a pattern, in samples from the first one.
inline float place_of(const BeamJob& beam, int64_t cut, float radians) {
  return (radians - float(beam.first_rad[cut])) * float(beam.samples_per_rad[cut]);
}

// Positions in the cuts of the direction (v0, v1, v2) along the antenna axes: azimuth atan2(v1, v0), and elevation.
inline float azimuth_place(const BeamJob& beam, float v0, float v1) { return place_of(beam, 0, angle(v1, v0)); }
inline float elevation_place(const BeamJob& beam, float v0, float v1, float v2) {
  return place_of(beam, 1, angle(v2, __builtin_sqrtf(v0 * v0 + v1 * v1)));
}

inline double last_rad(const BeamJob& beam, int64_t cut) {
  return beam.first_rad[cut] + double(beam.count[cut] - 1) / beam.samples_per_rad[cut];
}

// Gain at a position of a cut, linear between samples and zero beyond.
inline float look_up(const BeamJob& beam, int64_t cut, float place) {
  const int64_t last = beam.count[cut] - 1;
  const bool inside = place >= 0 && place <= float(last);
  const float held = inside ? place : 0;
  const int32_t at = int32_t(held) < int32_t(last) ? int32_t(held) : int32_t(last) - 1;  // AVX2 lacks 64 bits
  const float *gain = beam.gain[cut] + at, part = held - float(at);
  return inside ? gain[0] + part * (gain[1] - gain[0]) : 0;
}

}  // namespace
