// Struct layouts and constants of this build as text, for comparison with those of the Python binding.
#include <cstddef>
#include <cstdio>
#include <string>

#include "job.hpp"
#include "tree_job.hpp"

namespace {

struct Field {
  const char* name;
  int64_t offset, size;
};
#define APERTURA_FIELD(type, name) {#type "." #name, offsetof(type, name), sizeof(type::name)}
constexpr Field kFields[] = {
    APERTURA_FIELD(BeamJob, axes),
    APERTURA_FIELD(BeamJob, gain),
    APERTURA_FIELD(BeamJob, count),
    APERTURA_FIELD(BeamJob, first_rad),
    APERTURA_FIELD(BeamJob, samples_per_rad),
    APERTURA_FIELD(BeamJob, peak),
    {"BeamJob", 0, sizeof(BeamJob)},
    APERTURA_FIELD(SectorJob, axis),
    APERTURA_FIELD(SectorJob, centre),
    APERTURA_FIELD(SectorJob, inner),
    APERTURA_FIELD(SectorJob, outer),
    APERTURA_FIELD(SectorJob, end),
    APERTURA_FIELD(SectorJob, end_axis),
    APERTURA_FIELD(SectorJob, ends),
    {"SectorJob", 0, sizeof(SectorJob)},
    APERTURA_FIELD(ApertureJob, cells),
    APERTURA_FIELD(ApertureJob, transmitter),
    APERTURA_FIELD(ApertureJob, receiver),
    APERTURA_FIELD(ApertureJob, first_path),
    APERTURA_FIELD(ApertureJob, pixels),
    APERTURA_FIELD(ApertureJob, image),
    APERTURA_FIELD(ApertureJob, counts),
    APERTURA_FIELD(ApertureJob, pulses),
    APERTURA_FIELD(ApertureJob, padded),
    APERTURA_FIELD(ApertureJob, width),
    APERTURA_FIELD(ApertureJob, rows),
    APERTURA_FIELD(ApertureJob, columns),
    APERTURA_FIELD(ApertureJob, cells_per_metre),
    APERTURA_FIELD(ApertureJob, radians_per_cell),
    APERTURA_FIELD(ApertureJob, tolerance_rad),
    APERTURA_FIELD(ApertureJob, degree),
    APERTURA_FIELD(ApertureJob, phase_polynomial),
    APERTURA_FIELD(ApertureJob, wide_sum),
    APERTURA_FIELD(ApertureJob, phase_coefficients),
    APERTURA_FIELD(ApertureJob, beam),
    APERTURA_FIELD(ApertureJob, sector),
    {"ApertureJob", 0, sizeof(ApertureJob)},
    APERTURA_FIELD(TableJob, samples),
    APERTURA_FIELD(TableJob, taps),
    APERTURA_FIELD(TableJob, lead),
    APERTURA_FIELD(TableJob, carrier),
    APERTURA_FIELD(TableJob, turn),
    APERTURA_FIELD(TableJob, cells),
    APERTURA_FIELD(TableJob, pulses),
    APERTURA_FIELD(TableJob, length),
    APERTURA_FIELD(TableJob, width),
    APERTURA_FIELD(TableJob, up),
    APERTURA_FIELD(TableJob, down),
    APERTURA_FIELD(TableJob, steps),
    APERTURA_FIELD(TableJob, margin),
    APERTURA_FIELD(TableJob, used),
    APERTURA_FIELD(TableJob, degree),
    {"TableJob", 0, sizeof(TableJob)},
    APERTURA_FIELD(EchoJob, samples),
    APERTURA_FIELD(EchoJob, taps),
    APERTURA_FIELD(EchoJob, transmitter),
    APERTURA_FIELD(EchoJob, receiver),
    APERTURA_FIELD(EchoJob, start),
    APERTURA_FIELD(EchoJob, weight),
    APERTURA_FIELD(EchoJob, pixels),
    APERTURA_FIELD(EchoJob, edges),
    APERTURA_FIELD(EchoJob, columns),
    APERTURA_FIELD(EchoJob, sums),
    APERTURA_FIELD(EchoJob, objective),
    APERTURA_FIELD(EchoJob, slopes),
    APERTURA_FIELD(EchoJob, pulses),
    APERTURA_FIELD(EchoJob, length),
    APERTURA_FIELD(EchoJob, count),
    APERTURA_FIELD(EchoJob, blocks),
    APERTURA_FIELD(EchoJob, width),
    APERTURA_FIELD(EchoJob, weight_step),
    APERTURA_FIELD(EchoJob, samples_per_metre),
    APERTURA_FIELD(EchoJob, turns_per_metre),
    {"EchoJob", 0, sizeof(EchoJob)},
    APERTURA_FIELD(TermsJob, samples),
    APERTURA_FIELD(TermsJob, weights),
    APERTURA_FIELD(TermsJob, transmitter),
    APERTURA_FIELD(TermsJob, receiver),
    APERTURA_FIELD(TermsJob, start),
    APERTURA_FIELD(TermsJob, pixels),
    APERTURA_FIELD(TermsJob, terms),
    APERTURA_FIELD(TermsJob, pulses),
    APERTURA_FIELD(TermsJob, length),
    APERTURA_FIELD(TermsJob, count),
    APERTURA_FIELD(TermsJob, fractions),
    APERTURA_FIELD(TermsJob, step),
    APERTURA_FIELD(TermsJob, turns_per_metre),
    {"TermsJob", 0, sizeof(TermsJob)},
    APERTURA_FIELD(TreeTile, surface),
    APERTURA_FIELD(TreeTile, pixels),
    APERTURA_FIELD(TreeTile, image),
    APERTURA_FIELD(TreeTile, weight),
    APERTURA_FIELD(TreeTile, variant),
    APERTURA_FIELD(TreeTile, nodes),
    APERTURA_FIELD(TreeTile, n_virtual_pulses),
    APERTURA_FIELD(TreeTile, edge),
    APERTURA_FIELD(TreeTile, slope),
    APERTURA_FIELD(TreeTile, band),
    APERTURA_FIELD(TreeTile, turn),
    APERTURA_FIELD(TreeTile, centre),
    APERTURA_FIELD(TreeTile, rest),
    APERTURA_FIELD(TreeTile, first_path),
    APERTURA_FIELD(TreeTile, span),
    APERTURA_FIELD(TreeTile, slope_rms),
    APERTURA_FIELD(TreeTile, degree),
    APERTURA_FIELD(TreeTile, rows),
    APERTURA_FIELD(TreeTile, columns),
    APERTURA_FIELD(TreeTile, row_slot),
    APERTURA_FIELD(TreeTile, column_slot),
    APERTURA_FIELD(TreeTile, samples),
    APERTURA_FIELD(TreeTile, top),
    {"TreeTile", 0, sizeof(TreeTile)},
    APERTURA_FIELD(TreeJob, samples),
    APERTURA_FIELD(TreeJob, start),
    APERTURA_FIELD(TreeJob, transmitter),
    APERTURA_FIELD(TreeJob, receiver),
    APERTURA_FIELD(TreeJob, max_track_residual),
    APERTURA_FIELD(TreeJob, rms_track_residual),
    APERTURA_FIELD(TreeJob, track),
    APERTURA_FIELD(TreeJob, taps),
    APERTURA_FIELD(TreeJob, delay),
    APERTURA_FIELD(TreeJob, presum),
    APERTURA_FIELD(TreeJob, curve),
    APERTURA_FIELD(TreeJob, supports),
    APERTURA_FIELD(TreeJob, places),
    APERTURA_FIELD(TreeJob, spread),
    APERTURA_FIELD(TreeJob, mix),
    APERTURA_FIELD(TreeJob, tiles),
    APERTURA_FIELD(TreeJob, pulses),
    APERTURA_FIELD(TreeJob, length),
    APERTURA_FIELD(TreeJob, up),
    APERTURA_FIELD(TreeJob, lead),
    APERTURA_FIELD(TreeJob, stride),
    APERTURA_FIELD(TreeJob, count),
    APERTURA_FIELD(TreeJob, levels),
    APERTURA_FIELD(TreeJob, mono),
    APERTURA_FIELD(TreeJob, phase_polynomial),
    APERTURA_FIELD(TreeJob, taps_count),
    APERTURA_FIELD(TreeJob, delay_terms),
    APERTURA_FIELD(TreeJob, sizes),
    APERTURA_FIELD(TreeJob, curve_degrees),
    APERTURA_FIELD(TreeJob, step),
    APERTURA_FIELD(TreeJob, wavenumber),
    APERTURA_FIELD(TreeJob, band),
    APERTURA_FIELD(TreeJob, presum_error),
    APERTURA_FIELD(TreeJob, node_error),
    APERTURA_FIELD(TreeJob, beam),
    APERTURA_FIELD(TreeJob, sector),
    APERTURA_FIELD(TreeJob, phase_coefficients),
    {"TreeJob", 0, sizeof(TreeJob)},
};

struct Constant {
  const char* name;
  double value;
};
constexpr Constant kConstants[] = {
    {"patch_side", apertura::kPatchSide},
    {"block_side", apertura::kBlockSide},
    {"batch", apertura::kBatch},
    {"taps", apertura::kTaps},
    {"window", apertura::kWindow},
    {"echo_taps", apertura::kEchoTaps},
    {"echo_degree", apertura::kEchoDegree},
    {"term_taps", apertura::kTermTaps},
    {"window_margin", apertura::kWindowMargin},
    {"fifth_order", apertura::kFifthOrder},
    {"third_order", apertura::kThirdOrder},
    {"shared_curvature_error", apertura::kSharedCurvatureError},
    {"own_curvature_error", apertura::kOwnCurvatureError},
    {"curvature_span", apertura::kCurvatureSpan},
    {"weight_change", apertura::kWeightChange},
    {"weight_curvature", apertura::kWeightCurvature},
    {"sector_bend", apertura::kSectorBend},
    {"tree_nodes", apertura::kTreeNodes},
    {"tree_side", apertura::kTreeSide},
    {"tree_levels", apertura::kTreeLevels},
    {"tree_slots", apertura::kTreeSlots},
    {"tree_leaf", apertura::kTreeGroup},
    {"tree_virtual", apertura::kTreeMostVirtual},
    {"tree_virtual_margin", apertura::kTreeVirtualMargin},
    {"tree_terms", apertura::kTreeTerms},
    {"tree_degree", apertura::kTreeDegree},
    {"tree_delays", apertura::kTreeDelays},
    {"tree_weights", apertura::kTreeWeights},
    {"tree_weighted_rad", apertura::kTreeWeighted},
};

}  // namespace

extern "C" {

// One line for each field, "Struct.field offset size", and one for each struct, "Struct 0 size".
__attribute__((visibility("default"))) const char* apertura_layout() {
  static const std::string lines = [] {
    std::string text;
    for (const Field& field : kFields)
      text += std::string(field.name) + ' ' + std::to_string(field.offset) + ' ' + std::to_string(field.size) + '\n';
    return text;
  }();
  return lines.c_str();
}

// One line for each constant of bounds.hpp and tree_job.hpp that Python also defines: "name value".
__attribute__((visibility("default"))) const char* apertura_constants() {
  static const std::string lines = [] {
    std::string text;
    for (const Constant& constant : kConstants) {
      char line[64];
      std::snprintf(line, sizeof line, "%s %.7g\n", constant.name, constant.value);
      text += line;
    }
    return text;
  }();
  return lines.c_str();
}

}  // extern "C"
