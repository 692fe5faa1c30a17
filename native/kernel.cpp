// Kernel functions for one instruction set, APERTURA_ISA; compiled once for each.
#include "beam.hpp"
#include "echoes.hpp"
#include "expand.hpp"
#include "terms.hpp"

#define APERTURA_JOIN2(a, b) a##b
#define APERTURA_JOIN(a, b) APERTURA_JOIN2(a, b)

namespace {

// Sorts eight pulses by path variant and adds those with fast variants.
template <class Phase, int64_t kDegree, bool kTerrain>
void add_fast(const ApertureJob& job, const Patch& patch, int64_t pulse, int64_t pulses, const SectorPlaces* places,
              bool weighted, Batch& batch, float* sum) {
  bool edge = false;
  for (int64_t q = 0; places && q < pulses; q++) edge |= places->zone[q] != kInside;
  if (weighted) {
    sort_weighted<kTerrain>(job, patch, pulse, pulses, places, batch);
    add_pulses<Phase, kDegree, kTerrain, kWeighted>(job, patch, batch, sum);
    if (edge) add_pulses<Phase, kDegree, kTerrain, kWeightedAtEdge>(job, patch, batch, sum);
    return;
  }
  if (edge) {
    sort_at_edge<kTerrain>(job, patch, pulse, pulses, *places, batch);
    add_pulses<Phase, kDegree, kTerrain, kAtEdge>(job, patch, batch, sum);
  } else {
    sort_pulses<kTerrain>(job, patch, pulse, pulses, batch);
  }
  if constexpr (kLanes != 4) add_pulses<Phase, kDegree, kTerrain, kSharedCurvature>(job, patch, batch, sum);
  if constexpr (kLanes != 4 && kTerrain) add_pulses<Phase, kDegree, true, kLinearHeights>(job, patch, batch, sum);
  add_pulses<Phase, kDegree, kTerrain, kWideWindow>(job, patch, batch, sum);
  add_pulses<Phase, kDegree, kTerrain, kOwnCurvature>(job, patch, batch, sum);
}

template <class Phase, int64_t kDegree, bool kTerrain>
void add_patch(const ApertureJob& job, const Patch& patch, int64_t begin, int64_t end, float* sum) {
  Batch batch;
  Positions at;
  SectorPlaces places;
  alignas(64) float weight[kPixels];
  const bool weighted = job.beam[0] || job.beam[1], each = weighted || job.sector;
  bool gathered = false;
  for (int64_t pulse = begin; pulse < end; pulse += kBatch) {
    const int64_t pulses = end - pulse < kBatch ? end - pulse : kBatch;
    if (job.sector) {
      place_in_sector(job, patch, pulse, places);
      int64_t outside = 0;
      for (int64_t q = 0; q < pulses; q++) outside += places.zone[q] == kOutside;
      job.counts[3] += outside == pulses ? pulses : 0;
      if (outside == pulses) continue;
    }
    add_fast<Phase, kDegree, kTerrain>(job, patch, pulse, pulses, job.sector ? &places : nullptr, weighted, batch, sum);
    if (batch.count[kExactPath] && !gathered) gather(job, patch, at), gathered = true;
    for (int64_t n = 0; n < batch.count[kExactPath]; n++) {
      const int64_t one = pulse + batch.order[kExactPath][n];
      if (each) weigh_pixels(job, patch, at, one, weight);
      add_exact<Phase, kDegree>(job, patch, at, one, each ? weight : nullptr, sum);
    }
    job.counts[0] += batch.count[kSharedCurvature] + batch.count[kLinearHeights] + batch.count[kWideWindow];
    job.counts[1] += batch.count[kOwnCurvature] + batch.count[kWeighted] + batch.count[kAtEdge];
    job.counts[1] += batch.count[kWeightedAtEdge];
    job.counts[2] += batch.count[kExactPath];
    job.counts[3] += batch.count[kSkipped];
  }
}

template <class Phase, int64_t kDegree>
void add(const ApertureJob& job, const Patch& patch, int64_t begin, int64_t end, float* sum) {
  if (patch.terrain)
    add_patch<Phase, kDegree, true>(job, patch, begin, end, sum);
  else
    add_patch<Phase, kDegree, false>(job, patch, begin, end, sum);
}

template <class Phase>
void add(const ApertureJob& job, const Patch& patch, int64_t begin, int64_t end, float* sum) {
  job.degree == 2 ? add<Phase, 2>(job, patch, begin, end, sum) : add<Phase, 1>(job, patch, begin, end, sum);
}

}  // namespace

// Adds pulses begin..end of the job to `sum`: (2, 256) float, re then im, block by block.
extern "C" void APERTURA_JOIN(apertura_add_, APERTURA_ISA)(const ApertureJob* job, const apertura::Patch* patch,
                                                           int64_t begin, int64_t end, float* sum) {
  switch (job->phase_polynomial) {
    case 0: return add<Phase0>(*job, *patch, begin, end, sum);
    case 1: return add<Phase1>(*job, *patch, begin, end, sum);
    case 2: return add<Phase2>(*job, *patch, begin, end, sum);
    default: return add<Phase3>(*job, *patch, begin, end, sum);
  }
}

extern "C" void APERTURA_JOIN(apertura_expand_, APERTURA_ISA)(const TableJob* job, float* scratch) {
  expand(*job, scratch);
}

extern "C" void APERTURA_JOIN(apertura_contribute_, APERTURA_ISA)(const EchoJob* job) { contribute(*job); }

extern "C" void APERTURA_JOIN(apertura_differentiate_, APERTURA_ISA)(const EchoJob* job) { differentiate(*job); }

extern "C" void APERTURA_JOIN(apertura_terms_, APERTURA_ISA)(const TermsJob* job) { add_terms(*job); }
