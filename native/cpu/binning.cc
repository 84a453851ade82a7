#include "binning.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>

#include "prepare.h"

namespace splatax {
namespace {

constexpr int DIGIT_BITS = 11;  // of the radix sort, at most: three passes, or fewer where the keys are close together

constexpr int AHEAD = 16;  // splats that are prefetched
constexpr int SMALL_BOX = 4;  // tiles; smaller boxes are listed without testing the ellipse

// Maps floats to integers in the same order, negative ones too.
uint32_t sort_key(float depth) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

int box_tiles(const Splat& splat) {
  return (splat.last_column - splat.first_column + 1) * (splat.last_row - splat.first_row + 1);
}

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

}  // namespace

void Binning::collect(const Input& input, Workers& workers, int64_t max_pairs) {
  listed_ = NONE;
  seen_known_ = false;
  count_ = input.count;
  channel_count_ = input.channel_count;
  width_ = input.width;
  height_ = input.height;
  columns = (input.width + TILE - 1) / TILE;
  rows = (input.height + TILE - 1) / TILE;
  Splat* collected = collected_.at_least(input.count);
  uint32_t* keys = keys_.at_least(input.count);
  int32_t* places = places_.at_least(input.count);
  std::vector<int> found(workers.count(), 0), begins(workers.count(), 0);
  workers.ranges(input.count, [&](int range, int begin, int end) {
    int place = begin;
    for (int first = begin; first < end; first += LANES) {
      const Prepared rows(input, first, std::min(LANES, end - first));
      if (rows.drawn) rows.write(collected + place, [&](int row) { keys[place++] = sort_key(input.depths[row]); });
    }
    begins[range] = begin;
    found[range] = place - begin;
  });
  // Closes the gaps between the splats of the ranges, moving only keys and places.
  visible = found[0];
  for (int range = 1; range < workers.count(); ++range) {
    for (int i = 0; i < found[range]; ++i, ++visible) {
      keys[visible] = keys[begins[range] + i];
      places[visible] = begins[range] + i;
    }
  }
  std::iota(places, places + found[0], 0);
  order(workers);

  Splat* sorted = splats.at_least(visible);
  workers.ranges(visible, [&](int, int begin, int end) {
    for (int i = begin; i < end; ++i) {
      if (i + AHEAD < end) __builtin_prefetch(collected + places_[i + AHEAD]);
      sorted[i] = collected[places_[i]];
    }
  });
  divide(max_pairs);
}

// Divides the splats into rounds of at most `max_pairs`, or of one splat.
void Binning::divide(int64_t max_pairs) {
  rounds.assign(1, {0, visible});
  pairs_at_most = int64_t{visible} * tiles();
  if (pairs_at_most <= max_pairs / FEW) return;
  pairs_at_most = 0;
  for (int i = 0; i < visible; ++i) {
    const int more = box_tiles(splats[i]);
    if (pairs_at_most > 0 && pairs_at_most + more > max_pairs) {
      rounds.back().end = i;
      rounds.push_back({i, visible});
      pairs_at_most = 0;
    }
    pairs_at_most += more;
  }
}

// Sorts by the distance of keys from the least one, which has fewer digits than they have: the depths of a scene often
// share the leading bits.
void Binning::order(Workers& workers) {
  sorted_keys_.at_least(visible);
  sorted_places_.at_least(visible);
  if (visible == 0) return;
  const auto [least, most] = std::minmax_element(keys_.get(), keys_.get() + visible);
  const uint32_t origin = *least, span = *most - origin;
  const int bits = span == 0 ? 0 : 32 - __builtin_clz(span), passes = (bits + DIGIT_BITS - 1) / DIGIT_BITS;
  const int width = passes == 0 ? 0 : (bits + passes - 1) / passes, digits = 1 << width;
  for (int shift = 0; shift < bits; shift += width) {
    histogram_.clear(workers.count(), digits);
    const auto digit = [&](int i) { return ((keys_[i] - origin) >> shift) & (digits - 1); };
    workers.ranges(visible, [&](int range, int begin, int end) {
      int32_t* counts = histogram_.of(range);
      for (int i = begin; i < end; ++i) ++counts[digit(i)];
    });
    histogram_.place();
    workers.ranges(visible, [&](int range, int begin, int end) {
      int32_t* next = histogram_.of(range);
      for (int i = begin; i < end; ++i) {
        const int32_t to = next[digit(i)]++;
        sorted_keys_[to] = keys_[i];
        sorted_places_[to] = places_[i];
      }
    });
    std::swap(keys_, sorted_keys_), std::swap(places_, sorted_places_);
  }
}

void Binning::list(int number, Workers& workers) {
  if (listed_ == number) return;
  listed_ = number;
  seen_known_ = false;
  const Round& round = rounds[number];
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

}  // namespace splatax
