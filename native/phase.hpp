// The carrier's phase inside one cell as short polynomials. tables.py fits them and picks the form.
#pragma once
#include "lanes.hpp"

namespace {

// Terms of sine and cosine; kReduced first takes whole half turns off, for carriers that turn often in a cell.
template <int kSine, int kCosine, bool kReduced>
struct PhaseForm {
  Lanes c0, c1, c2, c3, s0, s1, s2, s3, turns;
  explicit PhaseForm(const float* p)
      : c0(splat(p[0])), c1(splat(p[1])), c2(splat(p[2])), c3(splat(p[3])), s0(splat(p[4])), s1(splat(p[5])),
        s2(splat(p[6])), s3(splat(p[7])), turns(splat(p[8])) {}

  inline void operator()(Lanes u, Lanes& cosine, Lanes& sine) const {
    Whole sign{};
    if constexpr (kReduced) {
      const Lanes scaled = u * turns, moved = scaled + kMagic;
      u = scaled - (moved - kMagic);
      sign = (Whole)moved << 31;
    }
    const Lanes z = u * u;
    if constexpr (kCosine == 3) cosine = c0 + z * (c1 + z * c2);
    if constexpr (kCosine == 4) cosine = c0 + z * (c1 + z * (c2 + z * c3));
    if constexpr (kSine == 2) sine = u * (s0 + z * s1);
    if constexpr (kSine == 3) sine = u * (s0 + z * (s1 + z * s2));
    if constexpr (kSine == 4) sine = u * (s0 + z * (s1 + z * (s2 + z * s3)));
    if constexpr (kReduced) {
      cosine = (Lanes)((Whole)cosine ^ sign);
      sine = (Lanes)((Whole)sine ^ sign);
    }
  }
};

using Phase0 = PhaseForm<2, 3, false>;
using Phase1 = PhaseForm<3, 4, false>;
using Phase2 = PhaseForm<4, 4, false>;
using Phase3 = PhaseForm<3, 4, true>;

}  // namespace
