// Subaperture trees on tiles of pixels, compiled once per instruction set; APERTURA_ISA names the copy.
#include "tree_leaf.hpp"
#include "tree_merge.hpp"
#include "tree_plan.hpp"

#define APERTURA_JOIN2(a, b) a##b
#define APERTURA_JOIN(a, b) APERTURA_JOIN2(a, b)

namespace {

constexpr int64_t kRowBytes = 1 << 19;  // of cells in work: what the second-level cache holds beside a tile

struct Work {
  Rows rows;
  LeafScratch leaf;
  MergeScratch merge;
};

bool any_taken(const TreeJob& job, const TreeTile& tile, int64_t begin, int64_t end) {
  for (int64_t p = begin; p < end && p < job.pulses; p += apertura::kTreeGroup)
    if (tile.way[p / apertura::kTreeGroup] == apertura::kByTree) return true;
  return false;
}

// Brings a leaf's sums up the tree, as far as its subapertures are complete; at the top of the tile to its pixels.
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

template <class Phase>
void add_leaf(const TreeJob& job, TileState& state, int64_t begin, int64_t end, Work& work) {
  const TreeTile& tile = state.tile;
  const bool taken = tile.way[begin / apertura::kTreeGroup] == apertura::kByTree;
  if (taken) {
    const uint8_t* nodes = tile.nodes + 2 * (begin / job.sizes[0]);
    const LeafNodes& leaf = leaf_of(job, state, nodes[0], nodes[1]);
    sum_leaf<Phase>(job, state, leaf, begin, end, work.rows, work.leaf);
    take_reference_off(job, state, leaf, apertura::middle_of(job, begin, job.sizes[0]), pair_stride(nodes[0]),
                       work.leaf);
  }
  climb(job, state, begin, end, taken, work);
}

template <class Phase>
void form(const TreeJob& job) {
  std::vector<std::unique_ptr<TileState>> states;
  for (int64_t n = 0; n < job.count; n++)
    if (job.tiles[n].top >= 0 && any_taken(job, job.tiles[n], 0, job.pulses))
      states.emplace_back(new TileState(job.tiles[n]));
  if (states.empty()) return;
  Work work;
  fold_carrier(job, work.rows);
  const int64_t leaf = job.sizes[0], row = int64_t(sizeof(float)) * kRecord * work.rows.width;
  const int64_t block = leaf * std::max<int64_t>(1, std::min<int64_t>(apertura::kTreeGroup, kRowBytes / row) / leaf);
  work.rows.cells.resize(size_t(block * kRecord * work.rows.width));
  work.rows.padded.resize(size_t(2 * (job.expanded + apertura::kTaps)));
  for (int64_t begin = 0; begin < job.pulses; begin += block) {
    const int64_t end = std::min(begin + block, job.pulses);
    work.rows.begin = begin;
    for (int64_t pulse = begin; pulse < end; pulse++) expand_pulse(job, pulse, work.rows);
    for (auto& state : states)
      for (int64_t at = begin; at < end; at += leaf)
        add_leaf<Phase>(job, *state, at, std::min(at + leaf, end), work);
  }
}

}  // namespace

// Fills `top`, `way` and `nodes` of the tiles, and what is to be expanded.
extern "C" void APERTURA_JOIN(apertura_plan_tree_, APERTURA_ISA)(TreeJob* job) { plan_tree(*job); }

// Adds the pulses that go by tree to the image.
extern "C" void APERTURA_JOIN(apertura_form_tree_, APERTURA_ISA)(TreeJob* job) {
  switch (job->phase_polynomial) {
    case 0: return form<Phase0>(*job);
    case 1: return form<Phase1>(*job);
    case 2: return form<Phase2>(*job);
    default: return form<Phase3>(*job);
  }
}
