// Stable sorting by counting, with a thread for each range of what is to be sorted: first each counts
// what it will put into which bucket, then each puts it there.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace splatax {

class Histogram {
 public:
  void clear(int ranges, int buckets) {
    ranges_ = ranges, buckets_ = buckets;
    counts_.assign(static_cast<size_t>(ranges) * buckets, 0);
  }

  // Of a range: a count for each bucket; after `place`, where the next of them goes.
  int32_t* of(int range) { return counts_.data() + static_cast<size_t>(range) * buckets_; }

  // Bucket after bucket, and range after range in each. Places of range 0 are where buckets begin.
  void place() {
    int32_t total = 0;
    for (int bucket = 0; bucket < buckets_; ++bucket) {
      for (int range = 0; range < ranges_; ++range) {
        int32_t& count = of(range)[bucket];
        total += count, count = total - count;
      }
    }
  }

 private:
  int ranges_ = 0, buckets_ = 0;
  std::vector<int32_t> counts_;
};

}  // namespace splatax
