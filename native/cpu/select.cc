#include "select.h"

#include "marks.h"
#include "tiles.h"

namespace splatax {
namespace {

// State of a tile; see `Selection`. Zero stands for no row.
template <int K>
struct TileSelection {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float median[BLOCKS][LANES];
  alignas(64) float weights[BLOCKS][K][LANES];
  alignas(64) float rows[BLOCKS][K][LANES];

  void clear(const Input& input, const Tile& tile) {
    std::memset(static_cast<void*>(this), 0, sizeof *this);
    let_light_through(input, tile, transmittance);
  }

  void walk(const Tile& tile, int count) {
    uint32_t live = live_blocks(transmittance);
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      for (int b = 0; b < BLOCKS; ++b) {
        if ((live >> b & 1) && touching[b] && !walk_block(chunk, touching[b], b, tile, first_pair, count)) {
          live &= ~(1u << b);
        }
      }
    });
  }

 private:
  // Visits the splats whose bits are set; returns false once all pixels of the block are finished.
  bool walk_block(const Chunk& chunk, uint64_t touching, int b, const Tile& tile, int first_pair, int count) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before), middle = load(median[b]);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching);
      const Blend step(chunk, i, x, y, T, alive);
      const Lanes row = broadcast(marked(tile.splats[tile.pairs[first_pair + i].splat].row));
      middle = where(step.drawn & (broadcast(0.5f) < T) & (step.after <= broadcast(0.5f)), row, middle);
      if (count > 0) insert(step.weight, row, b, count);
      T = step.after;
      alive = step.alive;
      if (count == 0) alive = alive & (broadcast(0.5f) < T);  // the median is found, and nothing else is asked for
      if (!any(alive)) break;
    }
    store(median[b], middle);
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    return any(alive);
  }

  // Inserts a weight where it is among the largest.
  void insert(Lanes weight, Lanes row, int b, int count) {
    if (!any(load(weights[b][count - 1]) < weight)) return;
    for (int k = 0; k < count; ++k) {
      const Lanes kept = load(weights[b][k]), kept_row = load(rows[b][k]);
      const Mask larger = kept < weight;
      store(weights[b][k], where(larger, weight, kept));
      store(rows[b][k], where(larger, row, kept_row));
      weight = where(larger, kept, weight);
      row = where(larger, kept_row, row);
    }
  }
};

template <int K>
void select_at_most(const Input& input, const Selection& selection, Workers& workers, Scratch& scratch) {
  const int count = selection.count;
  TileStates<TileSelection<K>> states(scratch.binning, scratch);
  each_round(scratch.binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileSelection<K>& state) {
      if (round.begin == 0) state.clear(input, tile);
      state.walk(tile, count);
      if (round.end < scratch.binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        selection.median[pixel] = row_of(state.median[b][lane]);
        for (int k = 0; k < count; ++k) {
          selection.weights[pixel * count + k] = state.weights[b][k][lane];
          selection.rows[pixel * count + k] = row_of(state.rows[b][k][lane]);
        }
      });
    });
  });
}

}  // namespace

void select(const Input& input, const Selection& selection, Workers& workers, Scratch& scratch, int64_t max_pairs) {
  scratch.binning.collect(input, workers, max_pairs);
  const auto run = selection.count <= 1   ? select_at_most<1>
                   : selection.count <= 8 ? select_at_most<8>
                                          : select_at_most<MOST_SELECTED>;
  run(input, selection, workers, scratch);
}

}  // namespace splatax
