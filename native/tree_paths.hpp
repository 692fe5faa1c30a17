// Paths to the nodes and pixels of a tile relative to its centre, and the reference phases that a tree removes and
// restores. Numbers in brackets are equations of docs/theory/tree.md, "References".
#pragma once
#include <vector>

#include "lanes.hpp"
#include "tree_job.hpp"

namespace {

using apertura::padded;

typedef std::vector<float> Floats;

// One pulse over one tile: 2 w, |w|^2 and |w| of both antennas, with w from the antenna to the tile's centre.
struct Legs {
  float transmitter[3], receiver[3], squares[2], ranges[2];
  double range;  // sum of |w| of both antennas
};

inline Legs legs_between(const double* centre, const double* transmitter, const double* receiver) {
  Legs legs;
  double square[2] = {};
  for (int64_t axis = 0; axis < 3; axis++) {
    const double t = centre[axis] - transmitter[axis], r = centre[axis] - receiver[axis];
    legs.transmitter[axis] = float(2 * t), legs.receiver[axis] = float(2 * r);
    square[0] += t * t, square[1] += r * r;
  }
  const double range[2] = {__builtin_sqrt(square[0]), __builtin_sqrt(square[1])};
  for (int64_t leg = 0; leg < 2; leg++) legs.squares[leg] = float(square[leg]), legs.ranges[leg] = float(range[leg]);
  legs.range = range[0] + range[1];
  return legs;
}
inline Legs legs_of(const TreeJob& job, const double* centre, int64_t pulse) {
  return legs_between(centre, job.transmitter + 3 * pulse, job.receiver + 3 * pulse);
}

// Offsets of points from a tile's centre, and their squared distances, metres: x, y, z, square, `count` of each.
struct Points {
  int64_t count = 0;  // a multiple of kLanes and of 8, padded with the last point
  Floats at;
  const float* x(int64_t n) const { return at.data() + n; }
  void resize(int64_t places) { count = padded(places, kLanes < 8 ? 8 : kLanes), at.assign(size_t(4 * count), 0.0f); }
  void put(int64_t n, const double* offset) {
    float square = 0;
    for (int64_t axis = 0; axis < 3; axis++) {
      const float value = float(offset[axis]);
      at[axis * count + n] = value, square += value * value;
    }
    at[3 * count + n] = square;
  }
  void fill(int64_t places) {
    for (int64_t n = places; n < count; n++)
      for (int64_t row = 0; row < 4; row++) at[row * count + n] = at[row * count + places - 1];
  }
};

// (2): |w + d| - |w| = q / (|w + d| + |w|), q = 2 w d + d^2, without cancellation.
inline Lanes extra_path(Lanes q, float square, float range) { return q * reciprocal(root(q + square) + range); }

inline Lanes leg_path(const float* w, float square, float range, Lanes x, Lanes y, Lanes z, Lanes d2) {
  return extra_path(x * w[0] + (y * w[1] + (z * w[2] + d2)), square, range);
}

// Path to a point minus the path to the centre, metres.
template <bool kMono = false>
inline Lanes path(const Legs& legs, Lanes x, Lanes y, Lanes z, Lanes d2) {
  const Lanes out = leg_path(legs.transmitter, legs.squares[0], legs.ranges[0], x, y, z, d2);
  if constexpr (kMono) return out + out;
  return out + leg_path(legs.receiver, legs.squares[1], legs.ranges[1], x, y, z, d2);
}
inline Lanes path(const Legs& legs, const Points& at, int64_t n) {
  const float* x = at.x(n);
  return path(legs, load(x), load(x + at.count), load(x + 2 * at.count), load(x + 3 * at.count));
}

// Cosine and sine of an angle in cycles: Taylor series of half the angle, then doubled.
inline void turn(Lanes turns, Lanes& cosine, Lanes& sine) {
  const Lanes x = (turns - nearest(turns)) * 3.14159265f, z = x * x;
  const Lanes s = x * (1 + z * (-1.6666667e-1f +
                                z * (8.3333333e-3f + z * (-1.9841270e-4f + z * (2.7557319e-6f + z * -2.5052108e-8f)))));
  const Lanes c =
      1 + z * (-.5f + z * (4.1666667e-2f +
                           z * (-1.3888889e-3f + z * (2.4801587e-5f + z * (-2.7557319e-7f + z * 2.0876757e-9f)))));
  cosine = 1 - 2 * s * s, sine = 2 * s * c;
}

// Factors for pairs (re, im): a times exp(j phase) is a * cosines + swap_pairs(a) * sines.
struct Turns {
  Floats cosines, sines;  // c c c c …, and -s s -s s …
  void resize(int64_t count) { cosines.resize(size_t(2 * count)), sines.resize(size_t(2 * count)); }
  void put(int64_t n, Lanes c, Lanes s) { store_pairs(&cosines[2 * n], c, c), store_pairs(&sines[2 * n], -s, s); }
};
inline Lanes turned(Lanes pairs, Lanes cosines, Lanes sines) { return pairs * cosines + swap_pairs(pairs) * sines; }

// (3) along one axis: exp(j k (R_child - R_parent)) at the points of a line; without a parent, exp(j k R_child).
inline void axis_turns(const TreeJob& job, const Points& line, const Legs& child, const Legs* parent, Turns& out) {
  const float turns_per_metre = float(job.wavenumber / 6.283185307179586);
  out.resize(line.count);
  for (int64_t n = 0; n < line.count; n += kLanes) {
    Lanes r = path(child, line, n), c, s;
    if (parent) r -= path(*parent, line, n);
    turn(r * turns_per_metre, c, s);
    out.put(n, c, s);
  }
}

}  // namespace
