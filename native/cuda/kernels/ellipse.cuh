// The ellipse in which a splat is drawn, and the tiles that it touches.
//
// Two kernels walk the same tiles: one counts them, the other writes them to the places counted. They must
// agree on every bit, so sums of products here are written as fmaf: the compiler has nothing left to choose.
#pragma once

#include "arguments.cuh"
#include "device.cuh"

// Same constants as in splatax/splats.py.
constexpr float MIN_ALPHA = 1.0f / 255, MAX_ALPHA = 0.99f, MIN_TRANSMITTANCE = 1e-4f;
constexpr float LOG2_MIN_ALPHA = -7.994353437f;
constexpr float ROOT_HALF_LOG2_E = 0.849321800f;  // sqrt(log2(e) / 2)

// With s = u dx + v dy and t = w dy, alpha is 2^(level - s^2 - t^2): u, v and w are those of `Splats`, times
// sqrt(log2(e) / 2).
struct Ellipse {
  float x, y, u, v, w;
  float level;  // log2(opacity)
};

INLINE Ellipse ellipse_of(const SplatRows& splats, int row) {
  const float* mean = splats.means2d + 2 * (size_t)row;
  const float* root = splats.sqrt_conics + 3 * (size_t)row;
  return {mean[0], mean[1], root[0] * ROOT_HALF_LOG2_E, root[1] * ROOT_HALF_LOG2_E, root[2] * ROOT_HALF_LOG2_E,
          log2f(splats.opacities[row])};
}

// s^2 + t^2 at an offset from the mean.
INLINE float exponent_at(const Ellipse& e, float dx, float dy) {
  const float s = fmaf(e.u, dx, e.v * dy), t = e.w * dy;
  return fmaf(s, s, t * t);
}

// Returns whether alpha reaches 1/255 anywhere in a rectangle: exact but for a margin of rounding, which never
// excludes a pixel that is drawn.
INLINE bool touches(const Ellipse& e, float left, float top, float right, float bottom) {
  const float reach = fmaf(e.level - LOG2_MIN_ALPHA, 1.0001f, 1e-4f);
  const float x0 = left - e.x, x1 = right - e.x, y0 = top - e.y, y1 = bottom - e.y;
  const float dx = fmaxf(x0, fminf(0.0f, x1)), dy = fmaxf(y0, fminf(0.0f, y1));  // nearest point of the rectangle
  // The least exponent is at the mean, or on one of the two edges that face it.
  const float uv = e.u * e.v;
  const float along_x = __fdividef(-uv * dy, e.u * e.u), along_y = __fdividef(-uv * dx, fmaf(e.v, e.v, e.w * e.w));
  const float least_x = fmaxf(x0, fminf(x1, along_x)), least_y = fmaxf(y0, fminf(y1, along_y));
  return (dx == 0 && dy == 0) || fminf(exponent_at(e, dx, least_y), exponent_at(e, least_x, dy)) <= reach;
}

// Number of the tile at a coordinate, limited to [0, tiles]; 0 for NaN.
INLINE int tile_at(float coordinate, int tiles) {
  return (int)fminf(fmaxf(floorf(coordinate * (1.0f / TILE)), 0.0f), (float)tiles);
}

// Calls visit(tile) for each tile that a splat touches, in row-major order. Culled splats touch none.
template <class Visit>
INLINE void each_tile(const SplatRows& splats, const Frame& frame, int row, const Visit& visit) {
  const float width = splats.extents[2 * (size_t)row], height = splats.extents[2 * (size_t)row + 1];
  if (!(width > 0 && height > 0)) return;
  const Ellipse e = ellipse_of(splats, row);
  const int left = tile_at(e.x - width, frame.columns), top = tile_at(e.y - height, frame.rows);
  const int right = min(tile_at(e.x + width, frame.columns), frame.columns - 1);
  const int bottom = min(tile_at(e.y + height, frame.rows), frame.rows - 1);
  for (int ty = top; ty <= bottom; ++ty) {
    for (int tx = left; tx <= right; ++tx) {
      const float x = (float)(tx * TILE) + 0.5f, y = (float)(ty * TILE) + 0.5f;
      if (touches(e, x, y, x + (TILE - 1), y + (TILE - 1))) visit(ty * frame.columns + tx);
    }
  }
}
