// Which splats touch which tile, nearest first.
//
//   1. collect   splats that are in the image, with the box of tiles of each
//   2. order     them by depth (radix sort, stable: ties stay in the order of the input)
//   3. list      in that order, append each to the tiles that its ellipse touches
//
// No list is sorted, because splats arrive in order. Splats are listed in rounds of at most so many
// (splat, tile) pairs; blending carries its state from one round to the next, so memory is bounded
// and nothing is ever dropped.
#pragma once

#include <cstdint>
#include <vector>

#include "buffer.h"
#include "histogram.h"
#include "parallel.h"
#include "splats.h"

namespace splatax {

// An entry of a tile's list.
struct Pair {
  int32_t splat;  // by depth
  int32_t index;  // of the pair, counted splat by splat
};

// The tiles of a row that a splat touches.
struct Span {
  uint16_t row, first, last;
};

// Splats [begin, end) by depth.
struct Round {
  int begin, end;
};

// A tile, and its list in a round.
struct Tile {
  int number, left, top;  // row by row; corner, pixels
  const Splat* splats;    // of all tiles
  const Pair* pairs;
  int count;              // of pairs
};

class Binning {
 public:
  // Steps 1 and 2. Afterwards `splats` holds `visible` of them by depth, in at least one round.
  void collect(const Input& input, Workers& workers, int64_t max_pairs);

  // Puts channels [first, first + size) of the input into the splats, unless they are there.
  void load_channels(const Input& input, int first, int size, Workers& workers);

  // Step 3 for one of `rounds`, unless it is the one that was listed last. Afterwards there are
  // `tile`s and their `pair_count()` pairs; those of splat i have the indices from
  // `first_pair[i - begin]` to the next one's.
  void list(int round, Workers& workers);

  int columns = 0, rows = 0, visible = 0;
  std::vector<Round> rounds;
  Buffer<Splat> splats;
  Buffer<int32_t> first_pair;

  // Whether the splats that were collected last came from an input of this size.
  bool fits(const Input& input) const {
    return input.count == count_ && input.channel_count == channel_count_ && input.width == width_ &&
           input.height == height_;
  }

  int tiles() const { return columns * rows; }
  int pair_count() const { return starts_[tiles()]; }
  Tile tile(int number) const {
    const int begin = starts_[number], end = starts_[number + 1];
    const int left = number % columns * TILE, top = number / columns * TILE;
    return {number, left, top, splats.get(), pairs_.get() + begin, end - begin};
  }

 private:
  static constexpr int NONE = -1;

  void order(Workers& workers);

  int listed_ = NONE, loaded_ = NONE;  // round, first channel
  int count_ = NONE, channel_count_ = NONE, width_ = NONE, height_ = NONE;  // of the input

  Buffer<Pair> pairs_;
  Buffer<int32_t> starts_;  // of the tiles' lists in `pairs_`, and their end

  Buffer<Splat> collected_;
  Buffer<uint32_t> keys_, sorted_keys_;
  Buffer<int32_t> places_, sorted_places_;
  Histogram histogram_;
  std::vector<std::vector<Span>> spans_;  // of each range of splats
};

}  // namespace splatax
