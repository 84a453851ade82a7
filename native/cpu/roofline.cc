#include "roofline.h"

#include "blending.h"

namespace splatax {
namespace {

// Counts slots, and those in which a splat is drawn; see `NoWatch`.
struct Slots {
  int32_t* counts;

  void begin(int) {}
  void see(const Effect& step, int) { counts[0] += LANES, counts[1] += __builtin_popcount(bits(step.drawn)); }
  void end(int) {}
};

}  // namespace

void count_slots(const Input& input, int32_t (*slots)[2], Workers& workers, Scratch& scratch, int64_t max_pairs) {
  Binning& binning = scratch.binning;
  binning.collect(input, workers, max_pairs);
  TileStates<TileImage<0>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileImage<0>& state) {
      int32_t(&counts)[2] = slots[tile.number];
      if (round.begin == 0) {
        state.clear(input, tile);
        counts[0] = counts[1] = 0;
      }
      state.blend(input, tile, Slots{counts});
    });
  });
}

void multiply_adds(int64_t rounds, float* sums, Workers& workers) {
  workers.each(workers.count(), [&](int thread) {
    Lanes chains[CHAINS];
    for (int k = 0; k < CHAINS; ++k) chains[k] = broadcast(static_cast<float>(k));
    const Lanes factor = broadcast(0.999f), addend = broadcast(0.001f);
    for (int64_t round = 0; round < rounds; ++round) {
      for (Lanes& chain : chains) chain = multiply_add(chain, factor, addend);
    }
    Lanes total = broadcast(0);
    for (const Lanes& chain : chains) total += chain;
    alignas(64) float each[LANES];
    store(each, total);
    sums[thread] = each[0];
  });
}

}  // namespace splatax
