// Arguments of the kernels: records of pointers to device memory, which the host fills and the kernels read.
// The same file is compiled for both, so the two cannot disagree.
#pragma once

#ifdef __CUDACC_RTC__
typedef unsigned char uint8_t;
typedef unsigned int uint32_t;
#else
#include <cstdint>
#endif

constexpr int TILE = 16;      // pixels a side
constexpr int PIXELS = 256;   // in a tile; also the threads of a block that draws one
constexpr int CHUNK = 128;    // splats of a tile between two checkpoints
constexpr int RECORD = 12;    // floats that the gradient kernel writes for a pair
constexpr int SCAN = 2048;    // numbers that a block sums up
constexpr int SORTED = 2048;  // items that a block sorts in one pass
constexpr int DIGITS = 256;   // values of a digit of the radix sort

// Rows of `Splats` in splatax/splats.py, and the channels to blend.
struct SplatRows {
  const float *means2d, *sqrt_conics, *depths, *extents, *opacities, *channels;
  int count, channel_count;
};

struct Frame {
  int width, height, columns, rows;  // pixels; tiles
};

// Number of items that a kernel works on. The host may not know it: then it is `*end - *begin`, or 0 if that
// is more than the buffers hold.
struct Items {
  int most;                    // capacity of the buffers
  const uint32_t *begin, *end;  // null where the number is `most`
};

// Splats by depth. `order[rank]` is a row of `SplatRows`; its (splat, tile) pairs have the numbers from
// `offsets[rank]` to `offsets[rank + 1]`.
struct DepthOrder {
  uint32_t *order, *offsets;
};

// Ranks [begin, end) whose pairs are listed at a time, numbered from 0.
struct Round {
  int begin, end;
  Items pairs;
};

// Pairs of a round, tile by tile, nearest first.
struct TileLists {
  uint32_t* pairs;         // numbers of the pairs
  uint32_t* owners;        // [pair] row of its splat
  uint32_t* starts;        // [tiles + 1] start of each tile's list in `pairs`
  uint32_t* first_chunks;  // [tiles + 1] chunks in the tiles before
  uint32_t* last_chunks;   // [tiles] chunks of each tile that blending reached
  float* checkpoints;      // [chunk][1 + channels][PIXELS]; null if no gradient follows
};

// Channels [first, first + C) of an image. They are blended together.
struct Image {
  float *sums, *alpha;  // [height width channel_count], [height width]
  float* light;         // transmittance between rounds, negative where finished; null if there is one round
  int first;
  bool continues;  // false in the first round
};

struct ImageGradient {
  const float *sums, *alpha;      // final image
  const float *d_sums, *d_alpha;  // cotangents
  int first;                      // first channel
};

// Contributions of the pairs of a round to the gradients of their splats.
struct PairRecords {
  float* records;    // [pair][RECORD]
  uint8_t* written;  // [pair] 0 where the splat is not drawn in the tile
};

struct SplatGradients {
  float *means2d, *sqrt_conics, *opacities, *channels;
  float* pull;  // null if not requested
  int first;    // first channel of the group whose contributions are added
};

// Rows of `Gaussians` in splatax/gaussians.py.
struct GaussianRows {
  const float *means, *quats, *log_scales, *opacity_logits, *sh;
  int count, coefficients;
};

// Numbers of a camera; their gradients have the same layout. The rotation is stored row by row.
enum CameraField { FX, FY, CX, CY, ROTATION, TRANSLATION = ROTATION + 9, POSITION = TRANSLATION + 3,
                   CAMERA_FIELDS = POSITION + 3 };

struct View {
  const float* camera;  // [CAMERA_FIELDS]
  int width, height;
  float variance;    // of the low-pass filter, pixels^2
  bool fades;        // true if the low-pass filter multiplies opacity by a factor,
  float least_fade;  // which is at least this
};

struct ProjectedRows {
  float *means2d, *sqrt_conics, *depths, *extents, *colors, *opacities;
};

// Cotangents of the projected rows, and the extents that were projected: zero where culled.
struct ProjectedCotangents {
  const float *means2d, *sqrt_conics, *depths, *extents, *colors, *opacities;
};

struct GaussianGradients {
  float *means, *quats, *log_scales, *opacity_logits, *sh;
  float* camera_parts;  // [block][CAMERA_FIELDS]
};

// Numbers of a training step, as splatax/backends/packed_steps.py packs them.
enum MoveNumber {
  GOOD,  // 0 if nothing may move
  MEAN_DECAY, MEAN_REST,  // REST is 1 - DECAY, rounded from double precision
  SQUARE_DECAY, SQUARE_REST,
  EPSILON,
  MEAN_CORRECTION, SQUARE_CORRECTION,  // 1 / (1 - DECAY^t)
  QUATS_RATE, LOG_SCALES_RATE, OPACITY_LOGITS_RATE,
  OPACITY_WEIGHT, SCALE_WEIGHT,  // of each opacity and of each scale in the loss
  NOISE_STRENGTH,
  PER_EXTENT,  // 1 / extent of the scene
  MOVE_NUMBERS
};

// Fields of a scene, of its gradients, or of moments.
template <class Number>
struct Fields {
  Number *means, *quats, *log_scales, *opacity_logits, *sh;
};

// A training step of the rows of a scene, in place.
struct Move {
  const float* numbers;     // [MOVE_NUMBERS]
  const float* mean_rates;  // one, or one for each row
  const float *sh_rates, *sh_free;  // for each coefficient; 0 where it is not learned yet
  const uint32_t* keys;             // two words for each block of rows
  int count, coefficients, rows_of_key;
  bool rate_for_each_row;
  Fields<const float> gradients;
  Fields<float> scene, mean, square;
};

// An image and a photo, [height width channels].
struct Pictures {
  const float *image, *photo;
  int width, height, channels;
};

// The loss is L1 of the pictures and their dissimilarity, each with a weight.
struct LossWeights {
  float absolute, similarity;
};
