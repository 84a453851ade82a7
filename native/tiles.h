// What the image and its gradient have in common: the walk over tiles, pixels and channels.
#pragma once

#include "rasterize.h"

namespace splatax {

// Calls visit(block, lane, pixel) for the pixels of a tile that are in the image.
template <class Visit>
void each_pixel(const Input& input, int left, int top, const Visit& visit) {
  for (int b = 0; b < BLOCKS; ++b) {
    for (int lane = 0; lane < LANES; ++lane) {
      const int x = left + b % BLOCKS_A_SIDE * BLOCK + lane % BLOCK;
      const int y = top + b / BLOCKS_A_SIDE * BLOCK + lane / BLOCK;
      if (x < input.width && y < input.height) visit(b, lane, static_cast<size_t>(y) * input.width + x);
    }
  }
}

// Calls body(first, size) for groups of channels; at least once, for alpha.
template <class Body>
void each_group(int channels, const Body& body) {
  int first = 0;
  do {
    body(first, std::min(GROUP, channels - first));
    first += GROUP;
  } while (first < channels);
}

// The states of tiles, which last from round to round. With a single round, as almost always, a
// state lives on the stack of the thread that works on it.
template <class State>
class TileStates {
 public:
  TileStates(const Binning& binning, Scratch& scratch) {
    if (binning.rounds.size() > 1) kept_ = scratch.states.aligned<State>(binning.tiles());
  }

  State& of(int tile, State& local) { return kept_ ? kept_[tile] : local; }

 private:
  State* kept_ = nullptr;
};

}  // namespace splatax
