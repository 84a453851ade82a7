// 2D Gaussians of one view, in the layouts of JAX and of the kernels.
#pragma once

#include <cstdint>

namespace splatax {

constexpr int TILE = 16;            // pixels a side
constexpr int BLOCK = 4;            // pixels a side: as many pixels as lanes
constexpr int BLOCKS_A_SIDE = TILE / BLOCK;
constexpr int BLOCKS = BLOCKS_A_SIDE * BLOCKS_A_SIDE;
constexpr int GROUP = 4;            // channels that are blended at a time

// Corner of a block in its tile, pixels.
constexpr int block_left(int b) { return b % BLOCKS_A_SIDE * BLOCK; }
constexpr int block_top(int b) { return b / BLOCKS_A_SIDE * BLOCK; }

// Same constants as in splatax/splats.py.
constexpr float MIN_ALPHA = 1.0f / 255;
constexpr float MAX_ALPHA = 0.99f;
constexpr float MIN_TRANSMITTANCE = 1e-4f;
constexpr float LOG2_MIN_ALPHA = -7.994353437f;
constexpr float ROOT_HALF_LOG2_E = 0.849321800f;  // sqrt(log2(e) / 2)

// Inputs, row by row; see `Splats` in splatax/splats.py.
struct Input {
  const float* means2d;      // [count 2]
  const float* sqrt_conics;  // [count 3]
  const float* depths;       // [count]
  const float* extents;      // [count 2]
  const float* opacities;    // [count]
  const float* channels;     // [count channel_count]
  int count, channel_count, width, height;
};

// One visible splat. With t = u dx + v dy and s = w dy, alpha is 2^(level - t^2 - s^2): u, v and w
// are those of `Splats`, times sqrt(log2(e) / 2).
struct alignas(64) Splat {
  float x, y, u, v, w;
  float level;             // log2(opacity)
  float reach;             // t^2 + s^2 beyond which alpha is under 1/255, and a margin for rounding
  float x_per_y, y_per_x;  // slopes to the nearest points on horizontal and vertical lines
  float channels[GROUP];   // up to here, floats without gaps: chunks read them as an array
  int32_t row;             // row of the input
  uint16_t first_column, last_column, first_row, last_row;  // tiles that its box covers
};
static_assert(sizeof(Splat) == 64, "one cache line");

}  // namespace splatax
