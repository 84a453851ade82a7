// Step 3 of binning.h: the lists of the tiles.
#include <algorithm>
#include <cmath>

#include "binning.h"

namespace splatax {
namespace {

constexpr int SMALL_BOX = 4;  // tiles; smaller boxes are listed without testing the ellipse
constexpr int WORD = 64;      // bits

// Returns whether the box is at most two tiles wide and high. Nearly all splats are so small in small images.
bool is_tiny(const Splat& splat) {
  return splat.last_column - splat.first_column <= 1 && splat.last_row - splat.first_row <= 1;
}

constexpr int NONES = 3;  // tiles that a tiny box may lack

// Calls body(tile, place) four times, for the tiles of a tiny box and their places among them. For a tile that the box
// does not have, `none` or one of the next two numbers is called: without branches, because their outcomes are as good as
// random, and with three numbers, so that a counter is not incremented three times in a row.
template <class Body>
void each_tile_of_tiny(const Splat& splat, int columns, int none, const Body& body) {
  const int right = splat.last_column - splat.first_column, down = splat.last_row - splat.first_row;
  const int corner = splat.first_row * columns + splat.first_column;
  body(corner, 0);
  body(right ? corner + 1 : none, 1);
  body(down ? corner + columns : none + 1, 1 + right);
  body(right & down ? corner + columns + 1 : none + 2, 3);
}

template <class Body>
void each_tile_of_box(const Splat& splat, const Body& body) {
  for (int row = splat.first_row; row <= splat.last_row; ++row) {
    for (int column = splat.first_column; column <= splat.last_column; ++column) body(row, column);
  }
}

// Written field by field: copying a fresh Span waits for its stores.
void append(std::vector<Span>& spans, int row, int first, int last) {
  spans.emplace_back();
  Span& span = spans.back();
  span.row = static_cast<uint16_t>(row);
  span.first = static_cast<uint16_t>(first);
  span.last = static_cast<uint16_t>(last);
}

bool is_small(const Splat& splat) { return box_tiles(splat) <= SMALL_BOX; }

// Appends the tiles that the ellipse t^2 + s^2 <= reach touches, row by row, and returns their number.
//
// At height dy the ellipse reaches from (-v dy - c) / u to (-v dy + c) / u with c^2 = reach - w^2 dy^2.
// Over a band of heights the right end is furthest where its derivative is zero, at
// dy = -v sqrt(reach) / (w sqrt(v^2 + w^2)), or at the end of the band next to that; the left end,
// by symmetry, opposite.
int append_spans(const Splat& splat, std::vector<Span>& spans) {
  const float root = std::sqrt(splat.reach);
  const float steep = splat.w * std::sqrt(splat.v * splat.v + splat.w * splat.w);
  const bool bounded = splat.u > 0 && steep > 0;
  const float height = bounded ? root / splat.w : 0;
  const float turn = bounded ? -splat.v * root / steep : 0;
  int count = 0;
  for (int row = splat.first_row; row <= splat.last_row; ++row) {
    int first = splat.first_column, last = splat.last_column;
    if (bounded) {
      const float low = std::max(row * TILE + 0.5f - splat.y, -height);
      const float high = std::min(row * TILE + TILE - 0.5f - splat.y, height);
      if (low > high) continue;
      const float right_at = std::clamp(turn, low, high), left_at = std::clamp(-turn, low, high);
      const auto chord = [&](float dy) {
        return std::sqrt(std::max(splat.reach - splat.w * splat.w * dy * dy, 0.0f));
      };
      const float right = splat.x + (chord(right_at) - splat.v * right_at) / splat.u;
      const float left = splat.x + (-chord(left_at) - splat.v * left_at) / splat.u;
      const float leftmost = std::max(std::ceil(left - 0.51f), static_cast<float>(first * TILE));
      const float rightmost = std::min(std::floor(right - 0.49f), last * TILE + TILE - 1.0f);
      if (!(leftmost <= rightmost)) continue;
      first = static_cast<int>(leftmost) / TILE;
      last = static_cast<int>(rightmost) / TILE;
    }
    append(spans, row, first, last);
    count += last - first + 1;
  }
  return count;
}

// Swaps the halves of J bits, beside the diagonal, of all blocks of 2 J x 2 J bits, then does the same for smaller J.
template <int J>
void swap_halves(uint64_t* rows) {
  constexpr uint64_t LOW = ~uint64_t{0} / ((uint64_t{1} << J) + 1);
  for (int block = 0; block < WORD; block += 2 * J) {
    for (int k = block; k < block + J; ++k) {
      const uint64_t different = ((rows[k] >> J) ^ rows[k + J]) & LOW;
      rows[k] ^= different << J;
      rows[k + J] ^= different;
    }
  }
  if constexpr (J > 1) swap_halves<J / 2>(rows);
}

// Transposes a matrix of bits (Warren, Hacker's Delight, Sec. 7-3).
void transpose(uint64_t (&rows)[WORD]) { swap_halves<WORD / 2>(rows); }

// Returns the tiles that a splat touches, one bit each, for an image of at most WORD tiles.
uint64_t tiles_touched(const Splat& splat, int columns, std::vector<Span>& spans) {
  const auto run = [](int first, int last) { return ((uint64_t{2} << last) - 1) >> first << first; };
  if (is_tiny(splat)) {  // without branches; see `each_tile_of_tiny`
    const uint64_t row = run(splat.first_column, splat.last_column);
    return row << splat.first_row * columns | row << splat.last_row * columns;
  }
  uint64_t tiles = 0;
  if (is_small(splat)) {
    each_tile_of_box(splat, [&](int row, int column) { tiles |= uint64_t{1} << (row * columns + column); });
    return tiles;
  }
  spans.clear();
  append_spans(splat, spans);
  for (const Span& span : spans) tiles |= run(span.first, span.last) << span.row * columns;
  return tiles;
}

}  // namespace

void Binning::list(int number, Workers& workers) {
  if (listed_ == number) return;
  listed_ = number;
  seen_known_ = false;
  const Round& round = rounds[number];
  if (tiles() <= WORD) return list_few(round, workers);
  const int count = round.end - round.begin, ranges = workers.count();
  int32_t* first = first_pair.at_least(count + 1);
  const int none = tiles();  // where tiny boxes have no tile
  histogram_.clear(ranges, tiles() + NONES);
  spans_.resize(std::max(spans_.size(), static_cast<size_t>(ranges)));
  workers.ranges(count, [&](int range, int begin, int end) {
    int32_t* counts = histogram_.of(range);
    std::vector<Span>& spans = spans_[range];
    spans.clear();
    for (int i = begin; i < end; ++i) {
      const Splat& splat = splats[round.begin + i];
      if (is_tiny(splat)) {
        first[i] = box_tiles(splat);
        each_tile_of_tiny(splat, columns, none, [&](int tile, int) { ++counts[tile]; });
        continue;
      }
      if (is_small(splat)) {  // the blocks of its tiles are tested later
        first[i] = box_tiles(splat);
        each_tile_of_box(splat, [&](int row, int column) { ++counts[row * columns + column]; });
        continue;
      }
      const size_t before = spans.size();
      first[i] = append_spans(splat, spans);
      for (size_t k = before; k < spans.size(); ++k) {
        for (int column = spans[k].first; column <= spans[k].last; ++column) {
          ++counts[spans[k].row * columns + column];
        }
      }
    }
    std::fill_n(counts + none, NONES, 0);
  });
  int32_t total = 0;
  for (int i = 0; i <= count; ++i) {
    const int32_t own = i < count ? first[i] : 0;
    first[i] = total;
    total += own;
  }
  histogram_.place();
  int32_t* begins = starts_.at_least(tiles() + 1);
  std::copy_n(histogram_.of(0), tiles() + 1, begins);
  Pair* all = pairs_.at_least(total + ranges);  // behind the lists, a place for each range's pairs with no tile
  workers.ranges(count, [&](int range, int begin, int end) {
    int32_t* next = histogram_.of(range);
    const Span* span = spans_[range].data();
    std::fill_n(next + none, NONES, total + range);
    for (int i = begin; i < end; ++i) {
      const Splat& splat = splats[round.begin + i];
      if (is_tiny(splat)) {
        each_tile_of_tiny(splat, columns, none, [&](int tile, int place) {
          all[next[tile]] = {round.begin + i, first[i] + place};
          next[tile] += tile < none;
        });
        continue;
      }
      if (is_small(splat)) {
        int32_t index = first[i];
        each_tile_of_box(splat, [&](int row, int column) { all[next[row * columns + column]++] = {round.begin + i, index++}; });
        continue;
      }
      for (int32_t index = first[i]; index < first[i + 1]; ++span) {
        for (int column = span->first; column <= span->last; ++column, ++index) {
          all[next[span->row * columns + column]++] = {round.begin + i, index};
        }
      }
    }
  });
}

// Lists the same for an image of at most WORD tiles: the tiles of a splat are a word, and each tile looks for its bit in all
// of them. In a small image, this is faster than to count and place the splats tile by tile, each after the one before it.
void Binning::list_few(const Round& round, Workers& workers) {
  const int count = round.end - round.begin, words = (count + WORD - 1) / WORD;
  int32_t* first = first_pair.at_least(count + 1);
  uint64_t* touched = touched_.at_least(static_cast<size_t>(words) * WORD);  // tiles of each splat
  spans_.resize(std::max(spans_.size(), static_cast<size_t>(workers.count())));
  workers.ranges(count, [&](int range, int begin, int end) {
    for (int i = begin; i < end; ++i) touched[i] = tiles_touched(splats[round.begin + i], columns, spans_[range]);
  });
  std::fill(touched + count, touched + words * WORD, uint64_t{0});
  int32_t total = 0;
  for (int i = 0; i < count; ++i) {
    first[i] = total;
    total += __builtin_popcountll(touched[i]);
  }
  first[count] = total;

  uint64_t* members = members_.at_least(static_cast<size_t>(words) * tiles());  // splats of each tile, one bit each
  workers.ranges(words, [&](int, int begin, int end) {
    for (int i = begin; i < end; ++i) {
      uint64_t matrix[WORD];
      std::copy_n(touched + static_cast<size_t>(i) * WORD, WORD, matrix);
      transpose(matrix);
      for (int tile = 0; tile < tiles(); ++tile) members[static_cast<size_t>(tile) * words + i] = matrix[tile];
    }
  });
  int32_t* begins = starts_.at_least(tiles() + 1);
  begins[0] = 0;
  for (int tile = 0; tile < tiles(); ++tile) {
    const uint64_t* own = members + static_cast<size_t>(tile) * words;
    begins[tile + 1] = begins[tile];
    for (int i = 0; i < words; ++i) begins[tile + 1] += __builtin_popcountll(own[i]);
  }
  Pair* all = pairs_.at_least(total);
  workers.each(tiles(), [&](int tile) {
    const uint64_t* own = members + static_cast<size_t>(tile) * words;
    const uint64_t before = (uint64_t{1} << tile) - 1;
    Pair* next = all + begins[tile];
    for (int i = 0; i < words; ++i) {
      for (uint64_t word = own[i]; word; word &= word - 1) {
        const int splat = i * WORD + __builtin_ctzll(word);
        *next++ = {round.begin + splat, first[splat] + __builtin_popcountll(touched[splat] & before)};
      }
    }
  });
}

}  // namespace splatax
