// One step of Adam, with the priors and the noise of the recipe, in one pass over the rows of a scene.
#pragma once

#include <cstdint>

#include "parallel.h"
#include "projection.h"

namespace splatax {

// Numbers of a step, as splatax/backends/cpu/moving.py packs them.
enum MoveNumber {
  GOOD,  // 0 if nothing may move
  MEAN_DECAY,
  MEAN_REST,  // 1 - MEAN_DECAY, rounded from double precision
  SQUARE_DECAY,
  SQUARE_REST,
  EPSILON,
  MEAN_CORRECTION,  // 1 / (1 - MEAN_DECAY^t)
  SQUARE_CORRECTION,
  QUATS_RATE,
  LOG_SCALES_RATE,
  OPACITY_LOGITS_RATE,
  OPACITY_WEIGHT,  // of each opacity in the loss
  SCALE_WEIGHT,    // of each scale in the loss
  NOISE_STRENGTH,
  PER_EXTENT,  // 1 / extent of the scene
  MOVE_NUMBERS
};

// The fields of a scene, of its gradients, or of moments.
template <class Number>
struct Fields {
  Number *means, *quats, *log_scales, *opacity_logits, *sh;
};

struct Move {
  const float* numbers;     // as MoveNumber
  const float* mean_rates;  // one, or one for each row
  bool rate_for_each_row;
  const float *sh_rates, *sh_free;  // for each coefficient; 0 where it is not learned yet
  const uint32_t* keys;             // two words for each block of rows
  int block;                        // rows that share a key
  int rows, coefficients;
  Fields<const float> gradients;
  Fields<float> scene, mean, square;  // changed in place
};

// Moves all rows. Each row depends on itself alone, so the result is the same for any number of threads.
void move_rows(const Move& move, Workers& workers);

// Moves all rows by gradients that are found on the way, and never kept; `move.gradients` are not read.
void move_rows(const Move& move, GradientByRows& gradients, Workers& workers);

}  // namespace splatax
