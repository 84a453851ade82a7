// SSIM (Wang et al. 2004) with moments in an 11 x 11 Gaussian window, zeros beyond the border, and L1:
//
//   S = A1 A2 / (B1 B2),   A1 = 2 mx my + C1,          B1 = mx^2 + my^2 + C1,
//                          A2 = 2 (xy - mx my) + C2,   B2 = xx - mx^2 + yy - my^2 + C2
//
// with blurred moments mx, my, xx, yy, xy. The window is symmetric, so blurring is its own adjoint:
//
//   dS/dx = blur(dS/dmx) + 2 x blur(dS/dxx) + y blur(dS/dxy) .
//
// One block for a tile of one channel, blurred down, then across, in shared memory.
#pragma once

#include "arguments.cuh"
#include "device.cuh"

constexpr int RADIUS = 5, HALO = TILE + 2 * RADIUS;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

// Weight of the window at a distance of k - RADIUS pixels: exp(-(k - RADIUS)^2 / (2 * 1.5^2)), normalized.
INLINE float window_weight(int k) {
  constexpr float weights[RADIUS + 1] = {0.00102838008f, 0.00759875814f, 0.0360007721f,
                                         0.10936069f,    0.213005538f,   0.266011715f};
  return weights[k <= RADIUS ? k : 2 * RADIUS - k];
}

// Tile and channel of this block, and the pixel of this thread.
struct Patch {
  int left, top, channel, column, row;
  bool inside;

  INLINE explicit Patch(const Pictures& p) {
    const int columns = (p.width + TILE - 1) / TILE, tile = blockIdx.x / p.channels;
    channel = blockIdx.x % p.channels;
    left = tile % columns * TILE;
    top = tile / columns * TILE;
    column = left + threadIdx.x % TILE;
    row = top + threadIdx.x / TILE;
    inside = column < p.width && row < p.height;
  }
  INLINE size_t index(const Pictures& p, int at_column, int at_row) const {
    return ((size_t)at_row * p.width + at_column) * p.channels + channel;
  }
  INLINE size_t index(const Pictures& p) const { return index(p, column, row); }

  // Copies the tile and its surroundings, zero beyond the border.
  INLINE void load(const Pictures& p, const float* from, float (*to)[HALO]) const {
    for (int i = threadIdx.x; i < HALO * HALO; i += BLOCK_SIZE) {
      const int x = left + i % HALO - RADIUS, y = top + i / HALO - RADIUS;
      const bool there = x >= 0 && y >= 0 && x < p.width && y < p.height;
      to[i / HALO][i % HALO] = there ? from[index(p, x, y)] : 0.0f;
    }
  }
};

// Sets blurred[n] of this thread's pixel to the window's mean of product(n, y, x), a number at a place of the halo.
template <int N, class Product>
INLINE void blur(float (&blurred)[N], float (*down)[TILE][HALO], const Product& product) {
  for (int i = threadIdx.x; i < TILE * HALO; i += BLOCK_SIZE) {
    const int y = i / HALO, x = i % HALO;
    float sums[N] = {};
    for (int k = 0; k <= 2 * RADIUS; ++k) {
      for (int n = 0; n < N; ++n) sums[n] = fmaf(window_weight(k), product(n, y + k, x), sums[n]);
    }
    for (int n = 0; n < N; ++n) down[n][y][x] = sums[n];
  }
  __syncthreads();
  const int y = threadIdx.x / TILE, x = threadIdx.x % TILE;
  for (int n = 0; n < N; ++n) {
    blurred[n] = 0;
    for (int k = 0; k <= 2 * RADIUS; ++k) blurred[n] = fmaf(window_weight(k), down[n][y][x + k], blurred[n]);
  }
}

// Returns the sum over the block, in thread 0.
INLINE float block_sum(float value) {
  __shared__ float warp_sums[WARPS];
  for (int distance = WARP_SIZE / 2; distance; distance /= 2) {
    value += __shfl_xor_sync(ALL_LANES, value, distance);
  }
  if (lane_number() == 0) warp_sums[warp_number()] = value;
  __syncthreads();
  float sum = 0;
  for (int w = 0; w < WARPS; ++w) sum += warp_sums[w];
  __syncthreads();
  return sum;
}

// Writes derivatives [3][height width channels] of the similarity by mx, xx and xy, and the block's part of the loss.
KERNEL __launch_bounds__(BLOCK_SIZE) photometric_loss(Pictures pictures, LossWeights weights, float* derivatives,
                                                      float* parts) {
  __shared__ float image[HALO][HALO], photo[HALO][HALO], down[5][TILE][HALO];
  const Patch patch(pictures);
  patch.load(pictures, pictures.image, image);
  patch.load(pictures, pictures.photo, photo);
  __syncthreads();
  float moments[5];
  blur(moments, down, [&](int n, int y, int x) {
    const float a = image[y][x], b = photo[y][x];
    return n == 0 ? a : n == 1 ? b : n == 2 ? a * a : n == 3 ? b * b : a * b;
  });
  float part = 0;
  if (patch.inside) {
    const float mx = moments[0], my = moments[1], xx = moments[2], yy = moments[3], xy = moments[4];
    const float a1 = 2 * mx * my + C1, b1 = mx * mx + my * my + C1;
    const float a2 = 2 * (xy - mx * my) + C2, b2 = xx - mx * mx + (yy - my * my) + C2;
    const float inverse = 1 / (b1 * b2), similarity = a1 * a2 * inverse;
    const float d_xx = -(similarity * b1 * inverse), d_xy = 2 * a1 * inverse;
    const float d_mx = 2 * (my * (a2 - a1) * inverse + mx * (-d_xx - similarity * b2 * inverse));
    const size_t at = patch.index(pictures), plane = (size_t)pictures.width * pictures.height * pictures.channels;
    derivatives[at] = d_mx;
    derivatives[plane + at] = d_xx;
    derivatives[2 * plane + at] = d_xy;
    const int y = threadIdx.x / TILE + RADIUS, x = threadIdx.x % TILE + RADIUS;
    part = weights.absolute * fabsf(image[y][x] - photo[y][x]) + weights.similarity * (1 - similarity);
  }
  const float sum = block_sum(part);
  if (threadIdx.x == 0) parts[blockIdx.x] = sum;
}

// Writes dL / d image.
KERNEL __launch_bounds__(BLOCK_SIZE) photometric_gradient(Pictures pictures, LossWeights weights,
                                                          const float* derivatives, float* gradient) {
  __shared__ float planes[3][HALO][HALO], down[3][TILE][HALO];
  const Patch patch(pictures);
  const size_t plane = (size_t)pictures.width * pictures.height * pictures.channels;
  for (int n = 0; n < 3; ++n) patch.load(pictures, derivatives + n * plane, planes[n]);
  __syncthreads();
  float d[3];
  blur(d, down, [&](int n, int y, int x) { return planes[n][y][x]; });
  if (!patch.inside) return;
  const size_t at = patch.index(pictures);
  const float x = pictures.image[at], y = pictures.photo[at];
  const float sign = x > y ? 1.0f : x < y ? -1.0f : 0.0f;
  gradient[at] = weights.absolute * sign - weights.similarity * (d[0] + 2 * x * d[1] + y * d[2]);
}

// Sums the parts of all blocks, in double precision: one block.
KERNEL __launch_bounds__(BLOCK_SIZE) sum_loss_parts(int blocks, const float* parts, float* loss) {
  __shared__ double sums[BLOCK_SIZE];
  double sum = 0;
  for (int b = threadIdx.x; b < blocks; b += BLOCK_SIZE) sum += parts[b];
  sums[threadIdx.x] = sum;
  for (int half = BLOCK_SIZE / 2; half; half /= 2) {
    __syncthreads();
    if ((int)threadIdx.x < half) sums[threadIdx.x] += sums[threadIdx.x + half];
  }
  if (threadIdx.x == 0) *loss = (float)sums[0];
}
