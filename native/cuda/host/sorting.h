// Prefix sums and sorts on the GPU.
#pragma once

#include "work.h"

namespace splatax::cuda {

// Sets out[0 .. n] to the sums of the numbers before each; out[n] is the sum of all. `out` may be `in`.
void prefix_sums(Work& work, int n, const uint32_t* in, uint32_t* out);

struct KeysAndValues {
  uint32_t *keys, *values;
};

// Sorts by the lowest `bits` of the keys; equal keys keep their order. Uses up what it is given, which must have
// room for `items.most`.
KeysAndValues sort(Work& work, const Items& items, int bits, KeysAndValues unsorted);

}  // namespace splatax::cuda
