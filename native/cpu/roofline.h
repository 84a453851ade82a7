// What the hardware allows: how much work there is in a picture, and how much this machine can do.
#pragma once

#include "rasterize.h"

namespace splatax {

// For each tile, how many (pixel, splat) pairs the rasterizer evaluates, and how many of them it draws.
void count_slots(const Input& input, int32_t (*slots)[2], Workers& workers, Scratch& scratch, int64_t max_pairs);

constexpr int CHAINS = 12;  // of multiply-adds that do not wait for each other

// So many rounds of CHAINS x LANES multiply-adds on each thread, which leaves a positive number in `sums`.
void multiply_adds(int64_t rounds, float* sums, Workers& workers);

}  // namespace splatax
