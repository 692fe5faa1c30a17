// Vectors of float as wide as the instruction set has, and the one operation C++ cannot say: a table
// look-up in a register. Everything is in an unnamed namespace: this header is compiled once per
// instruction set, and the linker must never merge those copies.
#pragma once
#include <cstdint>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Lanes __attribute__((vector_size(4 * kLanes), may_alias));
typedef int32_t Whole __attribute__((vector_size(4 * kLanes), may_alias));
typedef float LanesAnywhere __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

constexpr int kWindow = 16;                     // cells one look-up can reach
constexpr float kNarrow = kLanes == 8 ? 8 : 16;  // cells a single register permute can reach
constexpr float kMagic = 12582912.0f;           // 1.5 * 2^23: adding it rounds to the nearest integer

inline Lanes load(const float* from) { return *reinterpret_cast<const LanesAnywhere*>(from); }
inline void store(float* to, Lanes value) { *reinterpret_cast<LanesAnywhere*>(to) = value; }
inline Lanes splat(float value) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_set1_ps(value);
#elif defined(__AVX2__)
  return (Lanes)_mm256_set1_ps(value);
#else
  return Lanes{value, value, value, value};
#endif
}

// table[index] per lane; only the low bits of the index count, so no lane can read beside the window.
template <bool kWide>
inline Lanes look_up(const float* table, Whole index) {
#if defined(__AVX512F__)
  return (Lanes)_mm512_permutexvar_ps((__m512i)index, _mm512_loadu_ps(table));
#elif defined(__AVX2__)
  const __m256 low = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table), (__m256i)index);
  if constexpr (!kWide) return (Lanes)low;
  const __m256 high = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table + 8), (__m256i)index);
  return (Lanes)_mm256_blendv_ps(low, high, _mm256_castsi256_ps(_mm256_slli_epi32((__m256i)index, 28)));
#else
  Lanes found;
  for (int lane = 0; lane < kLanes; lane++) found[lane] = table[index[lane] & (kWindow - 1)];
  return found;
#endif
}

}  // namespace
