// Vectors of float with the width of the instruction set, and operations without a C++ equivalent such as a table
// look-up in a register. Everything is in an unnamed namespace: this header is compiled once per instruction set, and
// the linker must never merge the copies.
#pragma once
#include <cstdint>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

#include "bounds.hpp"

namespace {

using apertura::kWindow;

#if defined(__AVX512F__)
constexpr int64_t kLanes = 16;
#elif defined(__AVX2__)
constexpr int64_t kLanes = 8;
#else
constexpr int64_t kLanes = 4;
#endif

typedef float Lanes __attribute__((vector_size(4 * kLanes), may_alias));
typedef int32_t IntLanes __attribute__((vector_size(4 * kLanes), may_alias));
typedef float UnalignedLanes __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

constexpr float kNarrow = kLanes == 8 ? kWindow / 2 : kWindow;  // cells within reach of a single register permute
constexpr float kRounder = 12582912.0f;                         // 1.5 * 2^23: adding it rounds to the nearest integer

inline Lanes load(const float* from) { return *reinterpret_cast<const UnalignedLanes*>(from); }
inline void store(float* to, Lanes value) { *reinterpret_cast<UnalignedLanes*>(to) = value; }
inline Lanes splat(float value) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_set1_ps(value);
#elif defined(__AVX2__)
  return (Lanes)_mm256_set1_ps(value);
#else
  return Lanes{value, value, value, value};
#endif
}

inline float magnitude(float value) { return __builtin_fabsf(value); }
inline Lanes magnitude(Lanes value) { return (Lanes)((IntLanes)value & 0x7fffffff); }
inline Lanes floor(Lanes value) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_roundscale_ps((__m512)value, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
#elif defined(__AVX2__)
  return (Lanes)_mm256_floor_ps((__m256)value);
#else
  for (int64_t lane = 0; lane < kLanes; lane++) value[lane] = __builtin_floorf(value[lane]);
  return value;
#endif
}

// Clamps each lane to 0 … 1.
inline Lanes within_unit(Lanes value) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_min_ps(_mm512_max_ps((__m512)value, _mm512_setzero_ps()), _mm512_set1_ps(1));
#elif defined(__AVX2__)
  return (Lanes)_mm256_min_ps(_mm256_max_ps((__m256)value, _mm256_setzero_ps()), _mm256_set1_ps(1));
#else
  const Lanes zero{}, one = zero + 1.0f, above = value > zero ? value : zero;
  return above < one ? above : one;
#endif
}

// One boolean per lane; comparisons with NaN are false.
#if defined(__AVX512F__)
typedef __mmask16 LaneMask;
constexpr LaneMask kAllLanes = 0xffff;
inline LaneMask at_most(Lanes a, Lanes b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
inline bool all(LaneMask mask) { return mask == kAllLanes; }
#else
typedef IntLanes LaneMask;
constexpr LaneMask kAllLanes = ~IntLanes{};
inline LaneMask at_most(Lanes a, Lanes b) { return a <= b; }
#if defined(__AVX2__)
inline bool all(LaneMask mask) { return _mm256_movemask_ps((__m256)mask) == 0xff; }
#else
inline bool all(LaneMask mask) { return mask[0] & mask[1] & mask[2] & mask[3]; }
#endif
#endif

// Minimum of each group of four neighbouring lanes, in all four.
inline Lanes least_of_four(Lanes value) {
#if defined(__AVX512F__)
  const __m512 swapped = _mm512_min_ps((__m512)value, _mm512_permute_ps((__m512)value, 0xb1));
  return (Lanes)_mm512_min_ps(swapped, _mm512_permute_ps(swapped, 0x4e));
#elif defined(__AVX2__)
  const __m256 swapped = _mm256_min_ps((__m256)value, _mm256_permute_ps((__m256)value, 0xb1));
  return (Lanes)_mm256_min_ps(swapped, _mm256_permute_ps(swapped, 0x4e));
#else
  const Lanes swapped{value[1], value[0], value[3], value[2]}, pair = value < swapped ? value : swapped;
  const Lanes other{pair[2], pair[3], pair[0], pair[1]};
  return pair < other ? pair : other;
#endif
}

// One coefficient of the cells of a look-up window, in registers: 16 cells, or 8 if a register has 8 lanes and !kWide.
// Only the low bits of an index are used, so that no lane reads outside the window.
template <bool kWide>
struct WindowCells {
#if defined(__AVX512F__)
  __m512 cells;
  explicit WindowCells(const float* from) : cells(_mm512_loadu_ps(from)) {}
  Lanes operator[](IntLanes index) const { return (Lanes)_mm512_permutexvar_ps((__m512i)index, cells); }
#elif defined(__AVX2__)
  __m256 low, high;
  explicit WindowCells(const float* from) : low(_mm256_loadu_ps(from)), high(kWide ? _mm256_loadu_ps(from + 8) : low) {}
  Lanes operator[](IntLanes index) const {
    const __m256 first = _mm256_permutevar8x32_ps(low, (__m256i)index);
    if constexpr (!kWide) return (Lanes)first;
    const __m256 second = _mm256_permutevar8x32_ps(high, (__m256i)index);
    return (Lanes)_mm256_blendv_ps(first, second, _mm256_castsi256_ps(_mm256_slli_epi32((__m256i)index, 28)));
  }
#else
  const float* cells;
  explicit WindowCells(const float* from) : cells(from) {}
  Lanes operator[](IntLanes index) const {
    const IntLanes i = index & int32_t(kWindow - 1);
    return Lanes{cells[i[0]], cells[i[1]], cells[i[2]], cells[i[3]]};
  }
#endif
};

inline Lanes larger(Lanes a, Lanes b) { return a > b ? a : b; }   // b if a is NaN
inline Lanes smaller(Lanes a, Lanes b) { return a < b ? a : b; }  // b if a is NaN
inline Lanes nearest(Lanes value) { return (value + kRounder) - kRounder; }

// 1 / value, with an error of a few units in the last place.
inline Lanes reciprocal(Lanes value) {
#if defined(__AVX512F__)
  const Lanes y = (Lanes)_mm512_rcp14_ps((__m512)value);
#elif defined(__AVX2__)
  const Lanes y = (Lanes)_mm256_rcp_ps((__m256)value);
#else
  return 1.0f / value;
#endif
#if defined(__AVX2__)
  return y + y * (1.0f - value * y);
#endif
}

// Square root, with an error of a few units in the last place.
inline Lanes root(Lanes value) {
#if defined(__AVX512F__)
  const Lanes y = (Lanes)_mm512_rsqrt14_ps((__m512)value);
#elif defined(__AVX2__)
  const Lanes y = (Lanes)_mm256_rsqrt_ps((__m256)value);
#else
  for (int64_t lane = 0; lane < kLanes; lane++) value[lane] = __builtin_sqrtf(value[lane]);
  return value;
#endif
#if defined(__AVX2__)
  const Lanes near = value * y;
  return near + (0.5f * near) * (1.0f - near * y);
#endif
}

// Two floats, repeated in all pairs of lanes.
inline Lanes splat_pair(const float* from) {
  double both;
  __builtin_memcpy(&both, from, sizeof both);
#if defined(__AVX512F__)
  return (Lanes)_mm512_set1_pd(both);
#elif defined(__AVX2__)
  return (Lanes)_mm256_set1_pd(both);
#else
  return Lanes{from[0], from[1], from[0], from[1]};
#endif
}

// Exchanges the two floats of each pair of lanes.
inline Lanes swap_pairs(Lanes a) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_permute_ps((__m512)a, 0xb1);
#elif defined(__AVX2__)
  return (Lanes)_mm256_permute_ps((__m256)a, 0xb1);
#else
  return Lanes{a[1], a[0], a[3], a[2]};
#endif
}

// Stores a0 b0 a1 b1 …: 2 kLanes floats.
inline void store_pairs(float* to, Lanes a, Lanes b) {
#if defined(__AVX512F__)
  const __m512i low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const __m512i high = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
  _mm512_storeu_ps(to, _mm512_permutex2var_ps((__m512)a, low, (__m512)b));
  _mm512_storeu_ps(to + 16, _mm512_permutex2var_ps((__m512)a, high, (__m512)b));
#elif defined(__AVX2__)
  const __m256 low = _mm256_unpacklo_ps((__m256)a, (__m256)b), high = _mm256_unpackhi_ps((__m256)a, (__m256)b);
  _mm256_storeu_ps(to, _mm256_permute2f128_ps(low, high, 0x20));
  _mm256_storeu_ps(to + 8, _mm256_permute2f128_ps(low, high, 0x31));
#else
  store(to, Lanes{a[0], b[0], a[1], b[1]}), store(to + 4, Lanes{a[2], b[2], a[3], b[3]});
#endif
}

// Loads four floats from each of kLanes addresses: `fields[n]` contains the n-th float of all of them.
inline void load_records(const float* base, const int32_t* at, Lanes fields[4]) {
#if defined(__AVX512F__)
  __m512 q[4];
  for (int64_t n = 0; n < 4; n++) {
    q[n] = _mm512_castps128_ps512(_mm_loadu_ps(base + at[n]));
    q[n] = _mm512_insertf32x4(q[n], _mm_loadu_ps(base + at[n + 4]), 1);
    q[n] = _mm512_insertf32x4(q[n], _mm_loadu_ps(base + at[n + 8]), 2);
    q[n] = _mm512_insertf32x4(q[n], _mm_loadu_ps(base + at[n + 12]), 3);
  }
  const __m512d a = (__m512d)_mm512_unpacklo_ps(q[0], q[1]), b = (__m512d)_mm512_unpackhi_ps(q[0], q[1]);
  const __m512d c = (__m512d)_mm512_unpacklo_ps(q[2], q[3]), d = (__m512d)_mm512_unpackhi_ps(q[2], q[3]);
  fields[0] = (Lanes)_mm512_unpacklo_pd(a, c), fields[1] = (Lanes)_mm512_unpackhi_pd(a, c);
  fields[2] = (Lanes)_mm512_unpacklo_pd(b, d), fields[3] = (Lanes)_mm512_unpackhi_pd(b, d);
#elif defined(__AVX2__)
  __m256 q[4];
  for (int64_t n = 0; n < 4; n++) {
    q[n] = _mm256_castps128_ps256(_mm_loadu_ps(base + at[n]));
    q[n] = _mm256_insertf128_ps(q[n], _mm_loadu_ps(base + at[n + 4]), 1);
  }
  const __m256d a = (__m256d)_mm256_unpacklo_ps(q[0], q[1]), b = (__m256d)_mm256_unpackhi_ps(q[0], q[1]);
  const __m256d c = (__m256d)_mm256_unpacklo_ps(q[2], q[3]), d = (__m256d)_mm256_unpackhi_ps(q[2], q[3]);
  fields[0] = (Lanes)_mm256_unpacklo_pd(a, c), fields[1] = (Lanes)_mm256_unpackhi_pd(a, c);
  fields[2] = (Lanes)_mm256_unpacklo_pd(b, d), fields[3] = (Lanes)_mm256_unpackhi_pd(b, d);
#else
  const Lanes q[4] = {load(base + at[0]), load(base + at[1]), load(base + at[2]), load(base + at[3])};
  for (int64_t n = 0; n < 4; n++) fields[n] = Lanes{q[0][n], q[1][n], q[2][n], q[3][n]};
#endif
}

}  // namespace
