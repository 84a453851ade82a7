#include "survey.h"

#include "marks.h"
#include "tiles.h"
#include "wide.h"

namespace splatax {
namespace {

// State of a tile; see `TileImage` and `Survey`. Zero stands for no row.
template <int C>
struct TileSurvey {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float median[BLOCKS][LANES];
  alignas(64) float sums[C][BLOCKS][LANES];
  alignas(64) float parts[BLOCKS][MOST_PARTS][LANES];

  void clear(const Input& input, const Tile& tile, int part_count) {
    std::memset(median, 0, sizeof median);
    std::memset(sums, 0, sizeof sums);
    for (auto& block : parts) std::memset(block, 0, part_count * sizeof block[0]);
    let_light_through(input, tile, transmittance);
  }

  void walk(const Tile& tile, const Survey& survey) {
    uint32_t live = live_blocks(transmittance);
    Rows rows;
    each_chunk<C>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      rows.gather(tile, first_pair, chunk.size, survey);
      for (int b = 0; b < BLOCKS; ++b) {
        if ((live >> b & 1) && touching[b] && !walk_block(chunk, rows, touching[b], b, tile, survey.part_count > 0)) {
          live &= ~(1u << b);
        }
      }
    });
  }

 private:
  // Marks and parts of a chunk's splats.
  struct Rows {
    float mark[CHUNK];
    uint8_t part[CHUNK];

    void gather(const Tile& tile, int first_pair, int count, const Survey& survey) {
      for (int i = 0; i < count; ++i) {
        const int32_t row = tile.splats[tile.pairs[first_pair + i].splat].row;
        mark[i] = marked(row);
        part[i] = survey.part_count > 0 ? survey.part_of[row] : 0;
      }
    }
  };

  // Visits the splats whose bits are set; returns false once all pixels of the block are finished.
  bool walk_block(const Chunk& chunk, const Rows& rows, uint64_t touching, int b, const Tile& tile, bool by_part) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before), middle = load(median[b]);
    Lanes sum[C];
    for (int c = 0; c < C; ++c) sum[c] = load(sums[c][b]);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching);
      const Blend step(chunk, i, x, y, T, alive);
      const Mask halves = step.drawn & (broadcast(0.5f) < T) & (step.after <= broadcast(0.5f));
      middle = where(halves, broadcast(rows.mark[i]), middle);
      for (int c = 0; c < C; ++c) sum[c] = multiply_add(step.weight, broadcast(chunk.channels[c][i]), sum[c]);
      if (by_part) {
        float* own = parts[b][rows.part[i]];
        store(own, load(own) + step.weight);
      }
      T = step.after;
      alive = step.alive;
      if (!any(alive)) break;
    }
    store(median[b], middle);
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    for (int c = 0; c < C; ++c) store(sums[c][b], sum[c]);
    return any(alive);
  }
};

template <int C>
void survey_few(const Input& input, const Survey& results, Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  const int size = input.channel_count, part_count = results.part_count;
  TileStates<TileSurvey<C>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileSurvey<C>& state) {
      if (round.begin == 0) state.clear(input, tile, part_count);
      state.walk(tile, results);
      if (round.end < binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        float *sums = results.image.sums + pixel * size, *parts = results.parts + pixel * part_count;
        for (int c = 0; c < size; ++c) sums[c] = state.sums[c][b][lane];
        for (int p = 0; p < part_count; ++p) parts[p] = state.parts[b][p][lane];
        const float T = state.transmittance[b][lane];
        results.image.alpha[pixel] = 1 - (T < 0 ? -T : T);
        results.median[pixel] = row_of(state.median[b][lane]);
      });
    });
  });
}

}  // namespace

void survey(const Input& input, const Survey& results, Workers& workers, Scratch& scratch, int64_t max_pairs) {
  scratch.binning.collect(input, workers, max_pairs);
  const auto run = input.channel_count == 3 ? survey_few<3> : survey_few<GROUP>;
  run(input, results, workers, scratch);
}

}  // namespace splatax
