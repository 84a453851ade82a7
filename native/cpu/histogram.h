// Stable counting sort with a thread for each range of the input: each thread counts its items per bucket,
// then moves them there.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace splatax {

class Histogram {
 public:
  void clear(int ranges, int buckets) {
    ranges_ = ranges;
    buckets_ = buckets;
    counts_.assign(static_cast<size_t>(ranges) * buckets, 0);
  }

  // Counts of a range for each bucket; after `place`, the positions of their next items.
  int32_t* of(int range) { return counts_.data() + static_cast<size_t>(range) * buckets_; }

  // Assigns positions bucket by bucket, and range by range within a bucket. Those of range 0 are the
  // beginnings of the buckets.
  void place() {
    int32_t total = 0;
    for (int bucket = 0; bucket < buckets_; ++bucket) {
      for (int range = 0; range < ranges_; ++range) {
        int32_t& count = of(range)[bucket];
        total += count;
        count = total - count;
      }
    }
  }

 private:
  int ranges_ = 0, buckets_ = 0;
  std::vector<int32_t> counts_;
};

}  // namespace splatax
