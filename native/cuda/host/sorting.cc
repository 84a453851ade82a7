#include "sorting.h"

#include <utility>

namespace splatax::cuda {

void prefix_sums(Work& work, int n, const uint32_t* in, uint32_t* out) {
  const int runs = blocks_for(n, SCAN);
  auto* run_sums = work.allocate<uint32_t>(runs);
  work.launch("sum_runs", runs, n, in, out, run_sums);
  work.launch("sum_run_sums", 1, runs, run_sums, out + n);
  work.launch("add_run_sums", blocks_for(n), n, out, static_cast<const uint32_t*>(run_sums));
}

KeysAndValues sort(Work& work, const Items& items, int bits, KeysAndValues unsorted) {
  constexpr int BITS_IN_A_PASS = 8;
  const int blocks = blocks_for(items.most, SORTED);
  KeysAndValues from = unsorted, to{work.allocate<uint32_t>(items.most), work.allocate<uint32_t>(items.most)};
  const int counts = DIGITS * blocks;
  auto* places = work.allocate<uint32_t>(static_cast<size_t>(counts) + 1);
  for (int shift = 0; shift < bits; shift += BITS_IN_A_PASS) {
    const uint32_t *keys = from.keys, *values = from.values;
    work.launch("count_digits", blocks, items, shift, keys, places);
    prefix_sums(work, counts, places, places);
    work.launch("move_items", blocks, items, shift, keys, values, static_cast<const uint32_t*>(places), to.keys,
                to.values);
    std::swap(from, to);
  }
  return from;
}

}  // namespace splatax::cuda
