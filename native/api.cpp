// The entry points that Python binds, and the choice of the instruction set.
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

// Pulses in one pass over the tile, so that their tables stay in the second-level cache. A property of the
// tables alone: the order of summation must not depend on the tile.
int64_t block_length(const ApertureJob& job) {
  const int64_t bytes = 8 * (job.degree + 1) * job.width, fits = (768 << 10) / bytes / 8 * 8;
  return fits < 16 ? 16 : fits > 64 ? 64 : fits;
}

template <class Real>
void form_tile(const ApertureJob& job, const Entry& entry, const Patch* patches, int64_t count, Real* totals) {
  const int64_t block = block_length(job);
  for (int64_t begin = 0; begin < job.pulses; begin += block) {
    const int64_t end = begin + block < job.pulses ? begin + block : job.pulses;
    for (int64_t n = 0; n < count; n++) {
      alignas(64) float sum[2 * kPixels] = {};
      entry.add(&job, &patches[n], begin, end, sum);
      for (int slot = 0; slot < 2 * kPixels; slot++) totals[n * 2 * kPixels + slot] += Real(sum[slot]);
    }
  }
  for (int64_t n = 0; n < count; n++)
    for (int i = 0; i < patches[n].rows; i++)
      for (int j = 0; j < patches[n].columns; j++) {
        const int slot = (i / 4 * 4 + j / 4) * 16 + i % 4 * 4 + j % 4;
        const int64_t pixel = (patches[n].row + i) * job.columns + patches[n].column + j;
        const double* at = job.pixels + 3 * pixel;
        const bool placed = std::isfinite(at[0] + at[1] + at[2]);
        for (int part = 0; part < 2; part++)
          job.image[2 * pixel + part] =
              placed ? float(totals[(n * 2 + part) * kPixels + slot]) : std::nanf("");
      }
}

}  // namespace

extern "C" {

// The instruction set that `name` ("" for the best) selects here, or null if this machine has none of that name.
const char* apertura_form(const char* name) {
  const Entry* entry = find(name);
  return entry ? entry->name : nullptr;
}

// 0, or 1 if memory ran out, or 2 if this machine lacks the instruction set.
int apertura_expand(const char* name, const TableJob* job) {
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

int apertura_image(const char* name, const ApertureJob* job) {
  const Entry* entry = find(name);
  if (!entry) return 2;
  try {
    // A quarter of the tolerance, seen by both legs.
    const double bend = 0.125 * job->tolerance_rad / job->radians_per_cell;
    std::vector<Patch> patches(size_t((job->rows + kSide - 1) / kSide * ((job->columns + kSide - 1) / kSide)));
    size_t next = 0;
    for (int64_t row = 0; row < job->rows; row += kSide)
      for (int64_t column = 0; column < job->columns; column += kSide)
        apertura::fit(*job, row, column, bend, patches[next++]);
    if (job->wide_sum) {
      std::vector<double> totals(patches.size() * 2 * kPixels);
      form_tile(*job, *entry, patches.data(), int64_t(patches.size()), totals.data());
    } else {
      std::vector<float> totals(patches.size() * 2 * kPixels);
      form_tile(*job, *entry, patches.data(), int64_t(patches.size()), totals.data());
    }
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

}  // extern "C"
