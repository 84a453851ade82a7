// Blends the splats of a tile into its pixels: one block for a tile, one thread for a pixel.
#pragma once

#include "pixels.cuh"

template <int C>
INLINE void blend(const SplatRows& splats, const Frame& frame, const TileLists& lists, const Image& image) {
  __shared__ Ellipse ellipses[CHUNK];
  __shared__ float channels[CHUNK][C];
  const int tile = blockIdx.x;
  const Pixel pixel(frame, tile);
  const size_t index = pixel.index(frame);
  float* sums = image.sums + index * splats.channel_count + image.first;
  float T = 1, sum[C] = {};
  bool alive = pixel.inside;
  if (image.continues && pixel.inside) {
    T = fabsf(image.light[index]);
    alive = image.light[index] > 0;
    for (int c = 0; c < C; ++c) sum[c] = sums[c];
  }

  const int begin = lists.starts[tile], end = lists.starts[tile + 1];
  int chunk = 0;
  for (int base = begin; base < end; base += CHUNK, ++chunk) {
    if (!__syncthreads_or(alive)) break;
    const int count = min(CHUNK, end - base);
    load_splats<C>(splats, lists, lists.pairs + base, count, image.first, ellipses, channels);
    if (lists.checkpoints) {
      float* saved = lists.checkpoints + (lists.first_chunks[tile] + chunk) * checkpoint_size(splats) + pixel.in_tile;
      saved[0] = alive ? T : -T;
      for (int c = 0; c < C; ++c) saved[(1 + image.first + c) * PIXELS] = sum[c];
    }
    __syncthreads();
    for (int k = 0; k < count && __any_sync(ALL_LANES, alive); k += WARP_SIZE) {
      for (unsigned hits = touching(ellipses, k, count, pixel); hits; hits &= hits - 1) {
        const int i = k + __ffs(hits) - 1;
        const Blend step(ellipses[i], pixel, T);
        if (!alive || !step.drawn) continue;
        if (step.finished) {
          alive = false;
          continue;
        }
        for (int c = 0; c < C; ++c) sum[c] = fmaf(step.weight, channels[i][c], sum[c]);
        T = step.after;
      }
    }
  }

  if (pixel.inside) {
    for (int c = 0; c < C; ++c) sums[c] = sum[c];
    image.alpha[index] = 1 - T;
    if (image.light) image.light[index] = alive ? T : -T;
  }
  if (lists.checkpoints && threadIdx.x == 0) lists.last_chunks[tile] = chunk;
}

#define BLEND(C)                                                                                           \
  KERNEL __launch_bounds__(BLOCK_SIZE, RESIDENT)                                                                \
      blend_##C(SplatRows splats, Frame frame, TileLists lists, Image image) {                             \
    blend<C>(splats, frame, lists, image);                                                                 \
  }
BLEND(1)
BLEND(3)
BLEND(4)
