#include "limits.h"

#include "chunk.h"
#include "tiles.h"

namespace splatax {
namespace {

// A tile's transmittance alone, as the image goes through it.
struct SlotCounter {
  alignas(64) float transmittance[BLOCKS][LANES];

  void count(const Splat* splats, const Pair* pairs, int count, float left, float top, int32_t slots[2]) {
    const PixelCentres centres;
    uint32_t live = live_blocks(transmittance);
    each_chunk<0>(splats, pairs, count, left, top, live, [&](const Chunk& chunk, const uint64_t* touching, int) {
      for (int b = 0; b < BLOCKS; ++b) {
        const Lanes x = centres.x + all(left + b % BLOCKS_A_SIDE * BLOCK);
        const Lanes y = centres.y + all(top + b / BLOCKS_A_SIDE * BLOCK);
        for (uint64_t left_over = touching[b]; left_over && (live >> b & 1); left_over &= left_over - 1) {
          const Lanes before = load(transmittance[b]);
          const Mask alive = all(0) <= before;
          const Blend step(chunk, __builtin_ctzll(left_over), x, y, max(before, -before), alive);
          slots[0] += LANES, slots[1] += __builtin_popcount(bits(step.drawn));
          store(transmittance[b], where(step.alive, step.after, -step.after));
          if (!any(step.alive)) live &= ~(1u << b);
        }
      }
    });
  }
};

}  // namespace

void count_slots(const Input& input, int32_t (*slots)[2], Workers& workers, Scratch& scratch, int64_t max_pairs) {
  Binning& binning = scratch.binning;
  binning.collect(input, workers, max_pairs);
  TileStates<SlotCounter> states(binning, scratch);
  for (size_t number = 0; number < binning.rounds.size(); ++number) {
    binning.list(static_cast<int>(number), workers);
    workers.each(binning.tiles(), [&](int tile) {
      const int left = binning.left(tile), top = binning.top(tile), begin = binning.starts[tile];
      SlotCounter local, &state = states.of(tile, local);
      if (number == 0) {
        slots[tile][0] = slots[tile][1] = 0;
        for (auto& block : state.transmittance) std::fill(block, block + LANES, -1.0f);
        each_pixel(input, left, top, [&](int b, int lane, size_t) { state.transmittance[b][lane] = 1; });
      }
      state.count(binning.splats.get(), binning.pairs.get() + begin, binning.starts[tile + 1] - begin, left, top,
                  slots[tile]);
    });
  }
}

void multiply_adds(int64_t rounds, float* sums, Workers& workers) {
  workers.each(workers.count(), [&](int thread) {
    Lanes chains[CHAINS];
    for (int k = 0; k < CHAINS; ++k) chains[k] = all(static_cast<float>(k));
    const Lanes factor = all(0.999f), addend = all(0.001f);
    for (int64_t round = 0; round < rounds; ++round) {
      for (Lanes& chain : chains) chain = multiply_add(chain, factor, addend);
    }
    Lanes total = all(0);
    for (const Lanes& chain : chains) total += chain;
    alignas(64) float each[LANES];
    store(each, total);
    sums[thread] = each[0];
  });
}

}  // namespace splatax
