// Loops over rounds, tiles, pixels and channels, which the image and its gradient share.
#pragma once

#include "chunk.h"
#include "rasterize.h"

namespace splatax {

// Channels [first, first + size), which are blended in one walk.
struct Part {
  int first, size;
};

// Lists the pairs of each round in order, and calls body(round).
template <class Body>
void each_round(Binning& binning, Workers& workers, const Body& body) {
  for (size_t number = 0; number < binning.rounds.size(); ++number) {
    binning.list(static_cast<int>(number), workers);
    body(binning.rounds[number]);
  }
}

// States of tiles, which are kept from round to round. If there is a single round, as almost always, a
// state is on the stack of the thread that works on it.
template <class State>
class TileStates {
 public:
  TileStates(const Binning& binning, Scratch& scratch) : binning_(binning) {
    if (binning.rounds.size() > 1) kept_ = scratch.states.aligned<State>(binning.tiles());
  }

  // Calls visit(tile, state) for all tiles, with their lists of this round, on all threads.
  template <class Visit>
  void each_tile(Workers& workers, const Visit& visit) {
    workers.each(binning_.tiles(), [&](int number) {
      State local;
      visit(binning_.tile(number), kept_ ? kept_[number] : local);
    });
  }

 private:
  const Binning& binning_;
  State* kept_ = nullptr;
};

// Calls visit(block, lane, pixel) for the pixels of a tile that are in the image.
template <class Visit>
void each_pixel(const Input& input, const Tile& tile, const Visit& visit) {
  const bool whole = tile.left + TILE <= input.width && tile.top + TILE <= input.height;
  for (int b = 0; b < BLOCKS; ++b) {
    for (int lane = 0; lane < LANES; ++lane) {
      const int x = tile.left + block_left(b) + lane % BLOCK, y = tile.top + block_top(b) + lane / BLOCK;
      if (whole || (x < input.width && y < input.height)) visit(b, lane, static_cast<size_t>(y) * input.width + x);
    }
  }
}

// Writes `count` channels of a tile's pixels to an image with `stride` numbers a pixel. channel(b, c) is where those of
// block b begin, lane by lane.
template <class Channel>
void write_pixels(const Input& input, const Tile& tile, float* image, size_t stride, int count, const Channel& channel) {
  if (tile.left + TILE > input.width || tile.top + TILE > input.height) {
    each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
      for (int c = 0; c < count; ++c) image[pixel * stride + c] = channel(b, c)[lane];
    });
    return;
  }
  const size_t line = input.width * stride;
  for (int b = 0; b < BLOCKS; ++b) {
    float* corner = image + (tile.top + block_top(b)) * line + (tile.left + block_left(b)) * stride;
    if (stride == 1 && count == 1) {
      for (int row = 0; row < BLOCK; ++row) std::copy_n(channel(b, 0) + row * BLOCK, BLOCK, corner + row * line);
      continue;
    }
    for (int c = 0; c < count; c += GROUP) {
      write_columns([&](int k) { return channel(b, c + k); }, std::min(GROUP, count - c),
                    [&](int lane) { return corner + lane / BLOCK * line + lane % BLOCK * stride + c; });
    }
  }
}

// Transmittance before the first splat: 1, negated outside the image, where nothing is drawn.
inline void let_light_through(const Input& input, const Tile& tile, float (*transmittance)[LANES]) {
  for (int b = 0; b < BLOCKS; ++b) std::fill_n(transmittance[b], LANES, -1.0f);
  each_pixel(input, tile, [&](int b, int lane, size_t) { transmittance[b][lane] = 1; });
}

}  // namespace splatax
