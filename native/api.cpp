// Entry points for the Python binding, and selection of the instruction set.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <new>
#include <vector>
#ifdef APERTURA_X86
#include <cpuid.h>
#endif

#include "patch.hpp"
#include "tree_job.hpp"

using apertura::kPatchSide;
using apertura::kPixels;
using apertura::Patch;

#define APERTURA_DECLARE(isa)                                                                     \
  extern "C" void apertura_add_##isa(const ApertureJob*, const Patch*, int64_t, int64_t, float*); \
  extern "C" void apertura_expand_##isa(const TableJob*, float*);                                 \
  extern "C" void apertura_contribute_##isa(const EchoJob*);                                      \
  extern "C" void apertura_differentiate_##isa(const EchoJob*);                                   \
  extern "C" void apertura_terms_##isa(const TermsJob*);                                          \
  extern "C" void apertura_rest_tree_##isa(TreeJob*);                                             \
  extern "C" void apertura_weigh_tree_##isa(TreeJob*);                                            \
  extern "C" void apertura_view_tree_##isa(TreeJob*);                                             \
  extern "C" void apertura_plan_tree_##isa(TreeJob*);                                             \
  extern "C" void apertura_form_tree_##isa(TreeJob*);

APERTURA_DECLARE(portable)
#ifdef APERTURA_X86
APERTURA_DECLARE(avx2)
APERTURA_DECLARE(avx512)
#endif

namespace {

// Kernel functions compiled for one instruction set.
struct Isa {
  const char* name;
  bool runs;
  void (*add)(const ApertureJob*, const Patch*, int64_t, int64_t, float*);
  void (*expand)(const TableJob*, float*);
  void (*contribute)(const EchoJob*);
  void (*differentiate)(const EchoJob*);
  void (*terms)(const TermsJob*);
  void (*rest_tree)(TreeJob*);
  void (*weigh_tree)(TreeJob*);
  void (*view_tree)(TreeJob*);
  void (*plan_tree)(TreeJob*);
  void (*form_tree)(TreeJob*);
};

#ifdef APERTURA_X86
// Instruction sets of the processor whose registers the operating system saves (XCR0). Not __builtin_cpu_supports: the
// run-time library of zig answers it with "none" on every machine.
struct Cpu {
  bool avx2 = false, avx512 = false;

  Cpu() {
    unsigned a, b, c, d, ecx1;
    if (!__get_cpuid(1, &a, &b, &ecx1, &d) || !(ecx1 & bit_OSXSAVE)) return;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return;
    unsigned saved, high;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    const unsigned ymm = 0x6, zmm = 0xe6, needed = bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL;
    avx2 = (saved & ymm) == ymm && (ecx1 & bit_FMA) && (b & bit_AVX2);
    avx512 = avx2 && (saved & zmm) == zmm && (b & needed) == needed;
  }
};
#endif

// In descending order of speed.
const Isa* find(const char* name) {
#ifdef APERTURA_X86
  static const Cpu cpu;
#endif
  static const Isa isas[] = {
#ifdef APERTURA_X86
      {"avx512", cpu.avx512, apertura_add_avx512, apertura_expand_avx512, apertura_contribute_avx512,
       apertura_differentiate_avx512, apertura_terms_avx512, apertura_rest_tree_avx512, apertura_weigh_tree_avx512,
       apertura_view_tree_avx512, apertura_plan_tree_avx512, apertura_form_tree_avx512},
      {"avx2", cpu.avx2, apertura_add_avx2, apertura_expand_avx2, apertura_contribute_avx2, apertura_differentiate_avx2,
       apertura_terms_avx2, apertura_rest_tree_avx2, apertura_weigh_tree_avx2, apertura_view_tree_avx2,
       apertura_plan_tree_avx2, apertura_form_tree_avx2},
#endif
      {"portable", true, apertura_add_portable, apertura_expand_portable, apertura_contribute_portable,
       apertura_differentiate_portable, apertura_terms_portable, apertura_rest_tree_portable,
       apertura_weigh_tree_portable, apertura_view_tree_portable, apertura_plan_tree_portable,
       apertura_form_tree_portable},
  };
  for (const Isa& isa : isas)
    if (isa.runs && (!*name || std::strcmp(name, isa.name) == 0)) return &isa;
  return nullptr;
}

constexpr int64_t kPulses = 64;   // pulses per pass; together with kRegion, sized for the second-level cache
constexpr int64_t kRegion = 256;  // pixels along a side of a region; regions are formed sequentially
constexpr int64_t kSum = 2 * kPixels;

// Writes the sums of one patch to its pixels.
template <class Real>
void write(const ApertureJob& job, const Patch& patch, const Real* total) {
  for (int64_t slot = 0; slot < kPixels; slot++) {
    if (!holds(patch, slot)) continue;
    const int64_t row = patch.row + apertura::pixel_row(slot), column = patch.column + apertura::pixel_column(slot);
    const int64_t pixel = row * job.columns + column;
    const double* at = job.pixels + 3 * pixel;
    const bool placed = std::isfinite(at[0] + at[1] + at[2]);
    job.image[2 * pixel] = placed ? float(total[slot]) : std::nanf("");
    job.image[2 * pixel + 1] = placed ? float(total[kPixels + slot]) : std::nanf("");
  }
}

// Forms the patches of one region, with the loop over blocks of pulses outside. The order of summation in a patch does
// not depend on the region or the tile.
template <class Real>
void form_region(const ApertureJob& job, const Isa& isa, int64_t top, int64_t left, std::vector<Patch>& patches,
                 std::vector<Real>& totals) {
  // Deviation of a pixel that changes the total path by at most a quarter of the tolerance.
  const double deviation_cells = 0.125 * job.tolerance_rad / job.radians_per_cell;
  int64_t count = 0;
  for (int64_t row = top; row < top + kRegion && row < job.rows; row += kPatchSide)
    for (int64_t column = left; column < left + kRegion && column < job.columns; column += kPatchSide)
      apertura::fit(job, row, column, deviation_cells, patches[count++]);
  std::fill(totals.begin(), totals.end(), Real(0));
  for (int64_t begin = 0; begin < job.pulses; begin += kPulses) {
    const int64_t end = begin + kPulses < job.pulses ? begin + kPulses : job.pulses;
    for (int64_t n = 0; n < count; n++) {
      alignas(64) float sum[kSum] = {};
      isa.add(&job, &patches[n], begin, end, sum);
      for (int64_t slot = 0; slot < kSum; slot++) totals[n * kSum + slot] += Real(sum[slot]);
    }
  }
  for (int64_t n = 0; n < count; n++) write(job, patches[n], &totals[n * kSum]);
}

template <class Real>
void form_tile(const ApertureJob& job, const Isa& isa) {
  constexpr int64_t count = (kRegion / kPatchSide) * (kRegion / kPatchSide);
  std::vector<Patch> patches(count);
  std::vector<Real> totals(count * kSum);
  for (int64_t top = 0; top < job.rows; top += kRegion)
    for (int64_t left = 0; left < job.columns; left += kRegion) form_region(job, isa, top, left, patches, totals);
}

// Runs `work` with the named instruction set. Returns the status of the entry points.
template <class Work>
int run(const char* name, const Work& work) {
  const Isa* isa = find(name);
  if (!isa) return 2;
  try {
    work(*isa);
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

}  // namespace

extern "C" {

// Name of the instruction set that `name` selects ("": the best one), or null if this machine does not support it.
__attribute__((visibility("default"))) const char* apertura_isa(const char* name) {
  const Isa* isa = find(name);
  return isa ? isa->name : nullptr;
}

// Status: 0: success; 1: out of memory; 2: instruction set not supported by this machine.
__attribute__((visibility("default"))) int apertura_expand(const char* name, const TableJob* job) {
  return run(name, [job](const Isa& isa) {
    std::vector<float> scratch(apertura::scratch_length(*job));
    isa.expand(job, scratch.data());
  });
}

__attribute__((visibility("default"))) int apertura_image(const char* name, const ApertureJob* job) {
  return run(name,
             [job](const Isa& isa) { job->wide_sum ? form_tile<double>(*job, isa) : form_tile<float>(*job, isa); });
}

__attribute__((visibility("default"))) int apertura_contribute(const char* name, const EchoJob* job) {
  return run(name, [job](const Isa& isa) { isa.contribute(job); });
}

__attribute__((visibility("default"))) int apertura_differentiate(const char* name, const EchoJob* job) {
  return run(name, [job](const Isa& isa) { isa.differentiate(job); });
}

__attribute__((visibility("default"))) int apertura_terms(const char* name, const TermsJob* job) {
  return run(name, [job](const Isa& isa) { isa.terms(job); });
}

__attribute__((visibility("default"))) int apertura_rest_tree(const char* name, TreeJob* job) {
  return run(name, [job](const Isa& isa) { isa.rest_tree(job); });
}

__attribute__((visibility("default"))) int apertura_weigh_tree(const char* name, TreeJob* job) {
  return run(name, [job](const Isa& isa) { isa.weigh_tree(job); });
}

__attribute__((visibility("default"))) int apertura_view_tree(const char* name, TreeJob* job) {
  return run(name, [job](const Isa& isa) { isa.view_tree(job); });
}

__attribute__((visibility("default"))) int apertura_plan_tree(const char* name, TreeJob* job) {
  return run(name, [job](const Isa& isa) { isa.plan_tree(job); });
}

__attribute__((visibility("default"))) int apertura_form_tree(const char* name, TreeJob* job) {
  return run(name, [job](const Isa& isa) { isa.form_tree(job); });
}

}  // extern "C"
