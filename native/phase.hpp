// Carrier phase inside one cell, exp(j omega u) of (2), as an even and an odd polynomial in u. native_tables.py fits
// the coefficients and selects the cheapest polynomial with a sufficient accuracy.
#pragma once
#include "lanes.hpp"

namespace {

// kSine and kCosine: numbers of terms; kReduced: half cycles are removed first, for carriers with several per cell.
template <int64_t kSine, int64_t kCosine, bool kReduced>
struct PhasePolynomial {
  Lanes c0, c1, c2, c3, s0, s1, s2, s3, half_turns;
  explicit PhasePolynomial(const float* p)
      : c0(splat(p[0])), c1(splat(p[1])), c2(splat(p[2])), c3(splat(p[3])), s0(splat(p[4])), s1(splat(p[5])),
        s2(splat(p[6])), s3(splat(p[7])), half_turns(splat(p[8])) {}

  inline void operator()(Lanes u, Lanes& cosine, Lanes& sine) const {
    IntLanes sign{};
    if constexpr (kReduced) {
      // omega u = pi (n + rest), |rest| <= 1/2: an odd n flips the signs of both.
      const Lanes scaled = u * half_turns, rounded = scaled + kRounder;
      u = scaled - (rounded - kRounder);
      sign = (IntLanes)rounded << 31;
    }
    const Lanes z = u * u;
    if constexpr (kCosine == 3) cosine = c0 + z * (c1 + z * c2);
    if constexpr (kCosine == 4) cosine = c0 + z * (c1 + z * (c2 + z * c3));
    if constexpr (kSine == 2) sine = u * (s0 + z * s1);
    if constexpr (kSine == 3) sine = u * (s0 + z * (s1 + z * s2));
    if constexpr (kSine == 4) sine = u * (s0 + z * (s1 + z * (s2 + z * s3)));
    if constexpr (kReduced) {
      cosine = (Lanes)((IntLanes)cosine ^ sign);
      sine = (Lanes)((IntLanes)sine ^ sign);
    }
  }
};

using Phase0 = PhasePolynomial<2, 3, false>;
using Phase1 = PhasePolynomial<3, 4, false>;
using Phase2 = PhasePolynomial<4, 4, false>;
using Phase3 = PhasePolynomial<3, 4, true>;

}  // namespace
