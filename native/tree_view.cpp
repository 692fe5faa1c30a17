// Geometry of tiles for predictions, for one instruction set, APERTURA_ISA; compiled once for each. Separate from
// tree.cpp, because additional callers there change the inlining of functions and thereby the rounding of images.
#include "tree_plan.hpp"

#define APERTURA_JOIN2(a, b) a##b
#define APERTURA_JOIN(a, b) APERTURA_JOIN2(a, b)

namespace {

// Geometry that determines the plan's numbers of nodes and virtual pulses: bands (4b) of all subapertures, bands (8)
// and residuals (8b) of all leaves, and the span and RMS slope of paths over the tile.
inline void view_tile(const TreeJob& job, TreeTile& tile) {
  const Lattice lattice = lattice_of(job, tile);
  const Leaves leaves = leaves_of(job, tile, lattice);
  const Slopes mixed = mixed_slopes(job, tile, lattice), shared = slopes_at(shared_legs(job, tile), lattice);
  float* band = tile.band;
  for (int64_t level = 0; level < job.levels; level++)
    for (int64_t begin = 0; begin < job.pulses; begin += job.sizes[level], band += 2) {
      const Band of = band_of(job, tile, lattice, leaves, mixed, begin, job.sizes[level]);
      band[0] = Band::most(of.xi, lattice, 1), band[1] = Band::most(of.eta, lattice, lattice.side);
    }
  for (int64_t begin = 0; begin < job.pulses; begin += kTreeGroup) {
    const int64_t end = std::min(begin + kTreeGroup, job.pulses), three[3] = {begin, (begin + end - 1) / 2, end - 1};
    Reach reach[3];
    for (int64_t n = 0; n < 3; n++) reach[n] = reach_of(legs_of(job, tile.centre, three[n]), lattice);
    tile.turn[begin / kTreeGroup * 2] = float(carrier_turn(job, lattice, reach));
    tile.turn[begin / kTreeGroup * 2 + 1] = float(residual_turn(job, tile, lattice, (begin + end) / 2));
  }
  double square = 0;
  for (int64_t n = 0; n < lattice.count; n++) {
    square += double(shared.xi[n]) * shared.xi[n] + double(shared.eta[n]) * shared.eta[n];
    for (const Slopes& pulse : leaves.slopes)
      tile.span = std::max(tile.span, 2 * double(magnitude(pulse.xi[n]) + magnitude(pulse.eta[n])));
  }
  tile.slope_rms = std::sqrt(square / double(lattice.count));
}

}  // namespace

// Sets `band`, `turn`, `span` and `slope_rms` of the tiles.
extern "C" void APERTURA_JOIN(apertura_view_tree_, APERTURA_ISA)(TreeJob* job) {
  for (int64_t n = 0; n < job->count; n++) view_tile(*job, job->tiles[n]);
}
