// How threads share the pixels of a tile, and what one splat does to one pixel.
#pragma once

#include "ellipse.cuh"

constexpr int RESIDENT = 4;  // blocks of a multiprocessor at a time, which leaves 64 registers for each thread

// Pixel of this thread. A warp has 8 x 4 pixels, so that few of the splats that it walks miss all of them.
struct Pixel {
  static constexpr int WIDTH = 8, HEIGHT = 4;  // of a warp's pixels
  int left, top;    // first pixel of the warp
  int column, row;
  int in_tile;
  bool inside;      // the image

  INLINE Pixel(const Frame& frame, int tile) {
    const int lane = lane_number(), warp = warp_number();
    const int x = warp % 2 * WIDTH, y = warp / 2 * HEIGHT, own_x = x + lane % WIDTH, own_y = y + lane / WIDTH;
    const int tile_left = tile % frame.columns * TILE, tile_top = tile / frame.columns * TILE;
    left = tile_left + x;
    top = tile_top + y;
    column = tile_left + own_x;
    row = tile_top + own_y;
    in_tile = own_y * TILE + own_x;
    inside = column < frame.width && row < frame.height;
  }
  INLINE size_t index(const Frame& frame) const { return (size_t)row * frame.width + column; }
  INLINE float x() const { return column + 0.5f; }
  INLINE float y() const { return row + 0.5f; }
  INLINE bool warp_touched_by(const Ellipse& e) const {
    return touches(e, left + 0.5f, top + 0.5f, left + (WIDTH - 0.5f), top + (HEIGHT - 0.5f));
  }
};

// Splat i at one pixel: C += c_i a_i T_i and T_{i+1} = T_i (1 - a_i).
struct Blend {
  float dx, dy, s, t;
  float alpha, weight, after;  // a_i, a_i T_i, T_{i+1}
  bool clamped;   // alpha does not depend on the splat
  bool drawn;     // alpha is at least 1/255; false for NaN
  bool finished;  // drawing it would take T below its floor

  INLINE Blend(const Ellipse& e, const Pixel& pixel, float T) {
    dx = pixel.x() - e.x;
    dy = pixel.y() - e.y;
    s = fmaf(e.u, dx, e.v * dy);
    t = e.w * dy;
    const float raw = fast_exp2(fmaf(-s, s, fmaf(-t, t, e.level)));
    clamped = raw > MAX_ALPHA;
    drawn = raw >= MIN_ALPHA;
    alpha = fminf(raw, MAX_ALPHA);
    weight = T * alpha;
    after = fmaf(-T, alpha, T);  // the same bits in the gradient, which must stop where the blend did
    finished = after < MIN_TRANSMITTANCE;
  }
};

// Copies up to N splats of a list, from `pairs`, to shared memory.
template <int C>
INLINE void load_splats(const SplatRows& splats, const TileLists& lists, const uint32_t* pairs, int count, int first,
                        Ellipse* ellipses, float (*channels)[C]) {
  for (int k = threadIdx.x; k < count; k += BLOCK_SIZE) {
    const int row = lists.owners[pairs[k]];
    ellipses[k] = ellipse_of(splats, row);
    for (int c = 0; c < C; ++c) channels[k][c] = splats.channels[(size_t)row * splats.channel_count + first + c];
  }
}

// Bits of those of 32 splats, from `first` on, that touch the pixels of this warp.
INLINE unsigned touching(const Ellipse* ellipses, int first, int count, const Pixel& pixel) {
  const int own = first + lane_number();
  return __ballot_sync(ALL_LANES, own < count && pixel.warp_touched_by(ellipses[own]));
}

// Checkpoint of a chunk: T of each pixel of the tile, negative where finished, then sums of each channel.
INLINE size_t checkpoint_size(const SplatRows& splats) { return (size_t)(1 + splats.channel_count) * PIXELS; }
