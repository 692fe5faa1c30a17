// The entry points that Python binds, and the choice of the instruction set.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <new>
#include <vector>

#include "patch.hpp"

using apertura::kPixels;
using apertura::kSide;
using apertura::Patch;

#define APERTURA_DECLARE(form)                                                                      \
  extern "C" void apertura_add_##form(const ApertureJob*, const Patch*, int64_t, int64_t, float*); \
  extern "C" void apertura_expand_##form(const TableJob*, float*);

APERTURA_DECLARE(portable)
#ifdef APERTURA_X86
APERTURA_DECLARE(avx2)
APERTURA_DECLARE(avx512)
#endif

namespace {

struct Entry {
  const char* name;
  bool runs;
  void (*add)(const ApertureJob*, const Patch*, int64_t, int64_t, float*);
  void (*expand)(const TableJob*, float*);
};

// Fastest first.
const Entry* find(const char* name) {
#ifdef APERTURA_X86
  static const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  static const bool has_avx512 = has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                                 __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
#endif
  static const Entry entries[] = {
#ifdef APERTURA_X86
      {"avx512", has_avx512, apertura_add_avx512, apertura_expand_avx512},
      {"avx2", has_avx2, apertura_add_avx2, apertura_expand_avx2},
#endif
      {"portable", true, apertura_add_portable, apertura_expand_portable},
  };
  for (const Entry& entry : entries)
    if (entry.runs && (!*name || std::strcmp(name, entry.name) == 0)) return &entry;
  return nullptr;
}

constexpr int64_t kPulses = 64;      // in one pass: with kRegion, what the second-level cache holds
constexpr int64_t kRegion = 128;     // pixels on a side of what is finished before going on

// Writes the sums of one patch to its pixels.
template <class Real>
void write(const ApertureJob& job, const Patch& patch, const Real* total) {
  for (int i = 0; i < patch.rows; i++)
    for (int j = 0; j < patch.columns; j++) {
      const int block = i / 8 * 8 + j / 8 * 4 + i / 4 % 2 * 2 + j / 4 % 2, slot = block * 16 + i % 4 * 4 + j % 4;
      const int64_t pixel = (patch.row + i) * job.columns + patch.column + j;
      const double* at = job.pixels + 3 * pixel;
      const bool placed = std::isfinite(at[0] + at[1] + at[2]);
      job.image[2 * pixel] = placed ? float(total[slot]) : std::nanf("");
      job.image[2 * pixel + 1] = placed ? float(total[kPixels + slot]) : std::nanf("");
    }
}

// Forms the patches of one region, blocks of pulses in the outer loop. The order of summation of a patch does not
// depend on the region or the tile.
template <class Real>
void form_region(const ApertureJob& job, const Entry& entry, int64_t top, int64_t left, std::vector<Patch>& patches,
                 std::vector<Real>& totals) {
  // A quarter of the tolerance, seen by both legs.
  const double bend = 0.125 * job.tolerance_rad / job.radians_per_cell;
  size_t count = 0;
  for (int64_t row = top; row < top + kRegion && row < job.rows; row += kSide)
    for (int64_t column = left; column < left + kRegion && column < job.columns; column += kSide)
      apertura::fit(job, row, column, bend, patches[count++]);
  std::fill(totals.begin(), totals.end(), Real(0));
  for (int64_t begin = 0; begin < job.pulses; begin += kPulses) {
    const int64_t end = begin + kPulses < job.pulses ? begin + kPulses : job.pulses;
    for (size_t n = 0; n < count; n++) {
      alignas(64) float sum[2 * kPixels] = {};
      entry.add(&job, &patches[n], begin, end, sum);
      for (int slot = 0; slot < 2 * kPixels; slot++) totals[n * 2 * kPixels + slot] += Real(sum[slot]);
    }
  }
  for (size_t n = 0; n < count; n++) write(job, patches[n], &totals[n * 2 * kPixels]);
}

template <class Real>
void form_tile(const ApertureJob& job, const Entry& entry) {
  constexpr size_t count = (kRegion / kSide) * (kRegion / kSide);
  std::vector<Patch> patches(count);
  std::vector<Real> totals(count * 2 * kPixels);
  for (int64_t top = 0; top < job.rows; top += kRegion)
    for (int64_t left = 0; left < job.columns; left += kRegion) form_region(job, entry, top, left, patches, totals);
}

}  // namespace

extern "C" {

// The instruction set that `name` ("" for the best) selects here, or null if this machine has none of that name.
__attribute__((visibility("default"))) const char* apertura_form(const char* name) {
  const Entry* entry = find(name);
  return entry ? entry->name : nullptr;
}

// 0, or 1 if memory ran out, or 2 if this machine lacks the instruction set.
__attribute__((visibility("default"))) int apertura_expand(const char* name, const TableJob* job) {
  const Entry* entry = find(name);
  if (!entry) return 2;
  try {
    std::vector<float> scratch(size_t(2 * job->down * (job->steps + 48) + job->up * 2 * (job->degree + 1) * job->steps));
    entry->expand(job, scratch.data());
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

__attribute__((visibility("default"))) int apertura_image(const char* name, const ApertureJob* job) {
  const Entry* entry = find(name);
  if (!entry) return 2;
  try {
    job->wide_sum ? form_tile<double>(*job, *entry) : form_tile<float>(*job, *entry);
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

}  // extern "C"
