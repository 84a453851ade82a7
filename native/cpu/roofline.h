// Roofline of the rasterizer: the work in an image, and the peak speed of this machine.
#pragma once

#include "rasterize.h"

namespace splatax {

// Counts, for each tile, the (pixel, splat) pairs that the rasterizer evaluates, and those that it draws.
void count_slots(const Input& input, int32_t (*slots)[2], Workers& workers, Scratch& scratch, int64_t max_pairs);

constexpr int CHAINS = 12;  // independent chains of multiply-adds

// Runs rounds of CHAINS x LANES multiply-adds on each thread, and leaves a positive number in `sums`.
void multiply_adds(int64_t rounds, float* sums, Workers& workers);

}  // namespace splatax
