// Lists the splats that touch each tile, nearest first.
//
//   1. collect   splats that are in the image, with the box of tiles of each
//   2. order     them by depth (radix sort, stable: ties stay in the order of the input)
//   3. list      in that order, append each to the tiles that its ellipse touches
//
// No list is sorted, because splats arrive in order. A round lists a bounded number of (splat, tile) pairs.
// Blending carries its state from one round to the next, so memory is bounded and no pair is dropped.
#pragma once

#include <cstdint>
#include <vector>

#include "buffer.h"
#include "histogram.h"
#include "parallel.h"
#include "splats.h"

namespace splatax {

constexpr int CHUNK = 64;  // splats of a tile's list that are looked at together, one bit each in a word

// Entry of a tile's list.
struct Pair {
  int32_t splat;  // position in depth order
  int32_t index;  // number of the pair, counted splat by splat
};

// The tiles of a row that a splat touches.
struct Span {
  uint16_t row, first, last;
};

// Number of tiles of a splat's box.
inline int box_tiles(const Splat& splat) {
  return (splat.last_column - splat.first_column + 1) * (splat.last_row - splat.first_row + 1);
}

// Splats [begin, end) in depth order.
struct Round {
  int begin, end;
};

// Tile with its list in a round.
struct Tile {
  int number, left, top;  // number in row-major order; corner, pixels
  const Splat* splats;    // splats of all tiles
  const Pair* pairs;
  int count;              // number of pairs
  const uint64_t* seen;   // as `Binning::keep_seen` describes; null where it is not known
};

class Binning {
 public:
  static constexpr int FEW = 8;  // a round has few pairs if it has this many times fewer than it may have

  // Steps 1 and 2. Afterwards `splats` holds the `visible` splats in depth order, in at least one round, with their
  // channels if there are at most GROUP.
  void collect(const Input& input, Workers& workers, int64_t max_pairs);

  // Step 3 for one of `rounds`, unless it was the last one that was listed. Afterwards `tile` returns
  // the tiles of the round, which have `pair_count()` pairs. The pairs of splat i have the indices from
  // `first_pair[i - begin]` up to `first_pair[i - begin + 1]`.
  void list(int round, Workers& workers);

  int columns = 0, rows = 0, visible = 0;
  int64_t pairs_at_most = 0;  // of the last round: an upper bound
  std::vector<Round> rounds;
  Buffer<Splat> splats;
  Buffer<int32_t> first_pair;

  // Returns whether the splats that were collected last came from an input of this size.
  bool fits(const Input& input) const {
    return input.count == count_ && input.channel_count == channel_count_ && input.width == width_ &&
           input.height == height_;
  }

  // Room for what a walk over the tiles finds: for each chunk of a tile's list and each block of the tile, the splats with
  // an alpha of at least 1/255 at an unfinished pixel of the block. Other walks over the same lists skip the rest.
  void make_room_for_seen() { seen_.at_least(first_word(tiles())); }
  uint64_t* seen_of(int number) { return seen_.get() + first_word(number); }
  // Tells that the words of all tiles are written.
  void keep_seen() { seen_known_ = true; }

  int tiles() const { return columns * rows; }
  int pair_count() const { return starts_[tiles()]; }
  Tile tile(int number) const {
    const int begin = starts_[number], end = starts_[number + 1];
    const int left = number % columns * TILE, top = number / columns * TILE;
    const uint64_t* seen = seen_known_ ? seen_.get() + first_word(number) : nullptr;
    return {number, left, top, splats.get(), pairs_.get() + begin, end - begin, seen};
  }

 private:
  static constexpr int NONE = -1;

  void order(Workers& workers);
  void divide(int64_t max_pairs);
  void list_few(const Round& round, Workers& workers);
  // The words of a tile begin here: those of a list that begins anywhere end before the next one's.
  size_t first_word(int number) const { return (static_cast<size_t>(starts_[number]) / CHUNK + number) * BLOCKS; }

  int listed_ = NONE;  // round
  int count_ = NONE, channel_count_ = NONE, width_ = NONE, height_ = NONE;  // sizes of the input

  Buffer<Pair> pairs_;
  Buffer<int32_t> starts_;  // starts of the tiles' lists in `pairs_`, and their end
  Buffer<uint64_t> seen_;
  bool seen_known_ = false;

  Buffer<Splat> collected_;
  Buffer<uint32_t> keys_, sorted_keys_;
  Buffer<int32_t> places_, sorted_places_;
  Histogram histogram_;
  std::vector<std::vector<Span>> spans_;  // spans of each range of splats
  Buffer<uint64_t> touched_, members_;    // of `list_few`
};

}  // namespace splatax
