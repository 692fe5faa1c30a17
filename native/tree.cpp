// Subaperture trees on tiles of pixels for one instruction set, APERTURA_ISA; compiled once for each.
#include "tree_plan.hpp"
#include "tree_rows.hpp"

#define APERTURA_JOIN2(a, b) a##b
#define APERTURA_JOIN(a, b) APERTURA_JOIN2(a, b)

namespace {

struct Work {
  Rows rows;
  LeafScratch leaf;
  MergeScratch merge;
};

// Merges a leaf's sums into the higher levels whose subapertures are complete; at the top level, forms the pixels.
void climb(const TreeJob& job, TileState& state, int64_t begin, int64_t end, bool summed, Work& work) {
  const TreeTile& tile = state.tile;
  const float* pairs = work.leaf.pairs.data();
  for (int64_t level = 0;; level++) {
    const int64_t size = job.sizes[level];
    const uint8_t* mine = tile.nodes + apertura::first_of_level(job, level) + 2 * (begin / size);
    const Nodes from{mine[0], mine[1], pairs};
    const int64_t middle = apertura::middle_of(job, begin, size);
    if (level == tile.top) {
      if (summed) form_pixels(job, state, from, middle, work.merge);
      return;
    }
    const int64_t wider = job.sizes[level + 1], start = begin / wider * wider;
    const uint8_t* above = tile.nodes + apertura::first_of_level(job, level + 1) + 2 * (begin / wider);
    Floats& sum = state.sums[level + 1];
    if (begin == start) sum.assign(size_t(2 * pair_stride(above[0]) * above[1]), 0.0f);
    if (summed)
      merge(job, state, from, middle, apertura::middle_of(job, start, wider), above[0], above[1], sum.data(),
            work.merge);
    if (end < start + wider && end < job.pulses) return;
    pairs = sum.data(), begin = start;
    summed = any_taken(job, tile, start, start + wider);
  }
}

// Sums one leaf of every tile at its nodes: by virtual pulses if the plan provides them, otherwise pulse by pulse.
template <class Phase>
void sum_leaves(const TreeJob& job, std::vector<std::unique_ptr<TileState>>& states, int64_t begin, int64_t end,
                Work& work) {
  std::vector<TileState*> plain;
  for (auto& state : states) {
    const TreeTile& tile = state->tile;
    const int64_t number = begin / job.sizes[0];
    if (tile.variant[number] != apertura::kByTree) continue;
    state->leaf = &leaf_of(job, *state, tile.nodes[2 * number], tile.nodes[2 * number + 1]);
    for (Floats* plane : {&state->re, &state->im}) plane->assign(size_t(state->leaf->at.count + kLanes), 0.0f);
    if (!tile.n_virtual_pulses[number])
      plain.push_back(state.get());
    else if (job.mono)
      sum_virtual_pulses<Phase, true>(job, *state, *state->leaf, begin, work.leaf);
    else
      sum_virtual_pulses<Phase, false>(job, *state, *state->leaf, begin, work.leaf);
  }
  if (!plain.empty()) sum_each<Phase>(job, plain, begin, end, work.rows);
}

template <class Phase>
void form(const TreeJob& job) {
  std::vector<std::unique_ptr<TileState>> states;
  for (int64_t n = 0; n < job.count; n++)
    if (job.tiles[n].top >= 0 && any_taken(job, job.tiles[n], 0, job.pulses))
      states.emplace_back(new TileState(job.tiles[n]));
  Work work;
  for (int64_t begin = 0; begin < job.pulses && !states.empty(); begin += job.sizes[0]) {
    const int64_t end = std::min(begin + job.sizes[0], job.pulses);
    sum_leaves<Phase>(job, states, begin, end, work);
    for (auto& state : states) {
      const bool taken = state->tile.variant[begin / job.sizes[0]] == apertura::kByTree;
      if (taken)
        take_reference_off(job, *state, *state->leaf, apertura::middle_of(job, begin, job.sizes[0]),
                           pair_stride(state->leaf->columns), work.leaf);
      climb(job, *state, begin, end, taken, work);
    }
  }
}

}  // namespace

// Sets `top`, `variant`, `nodes`, `n_virtual_pulses`, `first_path`, `samples` and the weights of the tiles.
extern "C" void APERTURA_JOIN(apertura_plan_tree_, APERTURA_ISA)(TreeJob* job) {
  for (int64_t n = 0; n < job->count; n++) plan_tile(*job, job->tiles[n]);
}

// Sets `variant`, `edge`, `slope` and `weight` of the tiles from antennas and sector only; `n_virtual_pulses` is 1 for
// leaves whose weights jump from pulse to pulse.
extern "C" void APERTURA_JOIN(apertura_weigh_tree_, APERTURA_ISA)(TreeJob* job) {
  for (int64_t n = 0; n < job->count; n++) weigh_leaves(*job, job->tiles[n], lattice_of(*job, job->tiles[n]));
}

// Sets `rest` of the tiles.
extern "C" void APERTURA_JOIN(apertura_rest_tree_, APERTURA_ISA)(TreeJob* job) {
  for (int64_t n = 0; n < job->count; n++) job->tiles[n].rest = rest_of(*job, job->tiles[n]);
}

// Adds the pulses that are summed by tree to the image.
extern "C" void APERTURA_JOIN(apertura_form_tree_, APERTURA_ISA)(TreeJob* job) {
  switch (job->phase_polynomial) {
    case 0: return form<Phase0>(*job);
    case 1: return form<Phase1>(*job);
    case 2: return form<Phase2>(*job);
    default: return form<Phase3>(*job);
  }
}
