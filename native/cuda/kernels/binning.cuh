// Lists the splats that touch each tile, nearest first.
//
//   1. count_tiles   of each splat; keys for the sort by depth
//   2. order_counts  by depth; their prefix sums number the pairs
//   3. emit_pairs    in depth order; a stable sort by tile alone keeps that order in each tile
//   4. find_starts   of the tiles' lists
#pragma once

#include "ellipse.cuh"
#include "sorting.cuh"

// Key whose unsigned order is that of floats; zeros of either sign are equal.
INLINE uint32_t sortable(float depth) {
  const uint32_t bits = __float_as_uint(depth + 0.0f);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

KERNEL __launch_bounds__(BLOCK_SIZE) count_tiles(SplatRows splats, Frame frame, uint32_t* counts, uint32_t* keys,
                                                 uint32_t* rows) {
  const int row = thread_number();
  if (row >= splats.count) return;
  uint32_t count = 0;
  each_tile(splats, frame, row, [&](int) { ++count; });
  counts[row] = count;
  keys[row] = count ? sortable(splats.depths[row]) : ~0u;
  rows[row] = row;
}

KERNEL __launch_bounds__(BLOCK_SIZE) order_counts(int n, const uint32_t* rows, const uint32_t* counts, DepthOrder by_depth) {
  const int rank = thread_number();
  if (rank >= n) return;
  by_depth.order[rank] = rows[rank];
  by_depth.offsets[rank] = counts[rows[rank]];
}

KERNEL __launch_bounds__(BLOCK_SIZE) emit_pairs(SplatRows splats, Frame frame, DepthOrder by_depth, Round round,
                                                uint32_t* tiles, uint32_t* pairs, uint32_t* owners) {
  const int rank = round.begin + thread_number();
  if (rank >= round.end || count_of(round.pairs) == 0) return;
  const uint32_t base = by_depth.offsets[round.begin];
  uint32_t pair = by_depth.offsets[rank] - base;
  const uint32_t end = by_depth.offsets[rank + 1] - base;
  if (pair == end) return;
  const int row = by_depth.order[rank];
  each_tile(splats, frame, row, [&](int tile) {
    if (pair == end) return;
    tiles[pair] = tile;
    pairs[pair] = pair;
    owners[pair] = row;
    ++pair;
  });
}

// One thread for each pair, and one more for the end of the last list.
KERNEL __launch_bounds__(BLOCK_SIZE) find_starts(Items items, int tiles, const uint32_t* sorted_tiles,
                                                 const uint32_t* sorted_pairs, TileLists lists) {
  const int i = thread_number(), n = count_of(items);
  if (i > n) return;
  const int here = i < n ? (int)sorted_tiles[i] : tiles, before = i ? (int)sorted_tiles[i - 1] : -1;
  for (int tile = before + 1; tile <= here; ++tile) lists.starts[tile] = i;
  if (i < n) lists.pairs[i] = sorted_pairs[i];
}

KERNEL __launch_bounds__(BLOCK_SIZE) count_chunks(int tiles, TileLists lists) {
  const int tile = thread_number();
  if (tile < tiles) lists.first_chunks[tile] = (lists.starts[tile + 1] - lists.starts[tile] + CHUNK - 1) / CHUNK;
}
