#include "binning.h"

#include <algorithm>
#include <cstring>
#include <numeric>

#include "prepare.h"

namespace splatax {
namespace {

constexpr int DIGIT_BITS = 11;  // of the radix sort, at most: three passes, or fewer where the keys are close together

constexpr int AHEAD = 16;  // splats that are prefetched

// Maps floats to integers in the same order, negative ones too.
uint32_t sort_key(float depth) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
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

}  // namespace splatax
