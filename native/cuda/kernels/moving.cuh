// One training step of the rows of a scene, as splatax/moving.py defines it: priors, Adam, unit quaternions, and
// noise in the means. A warp moves 32 rows in one pass. It reads and writes a field as one run of numbers, lane
// after lane, and neither reads nor writes the centres, quaternions and harmonics of rows that rest, apart from
// the gradients. Operations of Adam are rounded one by one, so its results are the same on every device.
#pragma once

#include "ewa.cuh"
#include "normals.cuh"

// Same constants as in splatax/moving.py.
constexpr float SHARPNESS = 100, FAINT = 0.005f, NOISELESS = 0.17135532f, FADED = 9.5367431640625e-7f;

INLINE float times(float a, float b) { return __fmul_rn(a, b); }
INLINE float plus(float a, float b) { return __fadd_rn(a, b); }
INLINE float sigmoid(float x) { return 1 / (1 + expf(-x)); }

// Returns the bits that any lane of the warp has.
INLINE uint32_t of_all_lanes(uint32_t bits) {
  for (int distance = WARP_SIZE / 2; distance; distance /= 2) bits |= __shfl_xor_sync(ALL_LANES, bits, distance);
  return bits;
}

// Calls visit(i, row, place) for this lane's part of `rows` * `width` numbers; i = row * width + place.
template <class Visit>
INLINE void each_number(int rows, int width, const Visit& visit) {
  const int lane = lane_number(), rows_on = WARP_SIZE / width, places_on = WARP_SIZE % width;
  int row = lane / width, place = lane % width;
  for (int i = lane; i < rows * width; i += WARP_SIZE) {
    visit(i, row, place);
    row += rows_on;
    place += places_on;
    if (place < width) continue;
    place -= width;
    ++row;
  }
}

struct Adam {
  float decay, rest, square_decay, square_rest, epsilon, correction, square_correction;

  INLINE explicit Adam(const float* numbers)
      : decay(numbers[MEAN_DECAY]),
        rest(numbers[MEAN_REST]),
        square_decay(numbers[SQUARE_DECAY]),
        square_rest(numbers[SQUARE_REST]),
        epsilon(numbers[EPSILON]),
        correction(numbers[MEAN_CORRECTION]),
        square_correction(numbers[SQUARE_CORRECTION]) {}

  // Moves a number; returns whether it has changed. A number at rest is not written.
  INLINE bool step(float* value, float* mean_at, float* square_at, float gradient, float rate) const {
    const float before = *value, old_mean = *mean_at, old_square = *square_at;
    if (gradient == 0 && old_mean == 0) return false;
    const float square = plus(times(square_decay, old_square), times(square_rest, times(gradient, gradient)));
    const float mean = plus(times(decay, old_mean), times(rest, gradient));
    const float way = times(mean, correction) / plus(sqrtf(times(square, square_correction)), epsilon);
    const bool faded = gradient == 0 && fabsf(way) <= FADED;
    const float after = faded ? before : plus(before, -times(rate, way));
    *square_at = square;
    *mean_at = faded ? 0.0f : mean;
    *value = after;
    return after != before;
  }
};

// The 32 rows of a warp.
struct MovedRows {
  const Move& move;
  const int first, rows;
  const bool good;

  INLINE MovedRows(const Move& move, int first)
      : move(move), first(first), rows(min(move.count - first, WARP_SIZE)), good(move.numbers[GOOD] != 0) {}

  // Returns, in bits, which of the rows that are not in `known` have a number other than zero in this lane's part.
  template <class Counts>
  INLINE uint32_t nonzero(const float* field, int width, uint32_t known, const Counts& counts) const {
    const float* own = field + (size_t)first * width;
    uint32_t found = 0;
    each_number(rows, width, [&](int i, int row, int place) {
      const uint32_t bit = 1u << row;
      if (!(known & bit) && counts(place) && own[i] != 0) found |= bit;
    });
    return found;
  }

  // Returns, in bits, the rows of which more than opacity and scales moves.
  INLINE uint32_t awake() const {
    const auto all = [](int) { return true; };
    uint32_t found = nonzero(move.mean.means, 3, 0, all);
    if (good) found |= nonzero(move.gradients.means, 3, 0, all) | nonzero(move.gradients.quats, 4, 0, all);
    found = of_all_lanes(found);
    if (good && __any_sync(ALL_LANES, lane_number() < rows && !(found >> lane_number() & 1))) {
      const auto free = [&](int place) { return move.sh_free[place / 3] > 0; };
      found = of_all_lanes(found | nonzero(move.gradients.sh, 3 * move.coefficients, found, free));
    }
    return found;
  }

  // Makes a step of Adam with a field of the rows in `which`. Returns, in bits, those that this lane has changed.
  // `gradient_of(g, row, place, value)` and `rate_of(row, place)` belong to one number.
  template <class GradientOf, class RateOf>
  INLINE uint32_t step(const Adam& adam, float* Fields<float>::* field, const float* Fields<const float>::* of, int width,
                       uint32_t which, const GradientOf& gradient_of, const RateOf& rate_of) const {
    const size_t begin = (size_t)first * width;
    float *values = move.scene.*field + begin, *means = move.mean.*field + begin, *squares = move.square.*field + begin;
    const float* gradients = move.gradients.*of + begin;
    uint32_t changed = 0;
    each_number(rows, width, [&](int i, int row, int place) {
      const uint32_t bit = 1u << row;
      if (!(which & bit)) return;
      const float gradient = good ? gradient_of(gradients[i], row, place, values[i]) : 0.0f;
      const float rate = good ? rate_of(row, place) : 0.0f;
      if (adam.step(values + i, means + i, squares + i, gradient, rate)) changed |= bit;
    });
    return changed;
  }

  INLINE float mean_rate(int row) const { return move.mean_rates[move.rate_for_each_row ? (size_t)first + row : 0]; }
  // Returns whether a row is no empty slot, whose logit is minus infinity.
  INLINE bool lives(int row) const { return move.scene.opacity_logits[(size_t)first + row] >= -3.402823466e38f; }

  INLINE void normalize(int row) const {
    float* quat = move.scene.quats + 4 * ((size_t)first + row);
    float squared = 0;
    for (int k = 0; k < 4; ++k) squared = plus(squared, times(quat[k], quat[k]));
    const float length = sqrtf(squared);
    for (int k = 0; k < 4; ++k) quat[k] = squared <= 0 ? 0.0f : quat[k] / length;
  }

  // Adds noise to the centre of a faint Gaussian; see `splatax.moving.shaken`.
  INLINE void shake(int row) const {
    const size_t at = (size_t)first + row;
    const float opacity = sigmoid(move.scene.opacity_logits[at]);
    if (!lives(row) || !(opacity < NOISELESS)) return;
    const float gate = sigmoid(-SHARPNESS * (opacity - FAINT));
    const uint32_t* key = move.keys + 2 * (at / move.rows_of_key);
    const unsigned long long drawn = 3ull * (at % move.rows_of_key);
    const Vector noise{gate * normal_deviate(key, drawn), gate * normal_deviate(key, drawn + 1),
                       gate * normal_deviate(key, drawn + 2)};
    const Matrix axes = Turn(move.scene.quats + 4 * at).rotation();
    const Vector along = transposed_times(axes, noise);
    const float* log_scales = move.scene.log_scales + 3 * at;
    const float x = move.numbers[PER_EXTENT] * expf(log_scales[0]), y = move.numbers[PER_EXTENT] * expf(log_scales[1]);
    const float z = move.numbers[PER_EXTENT] * expf(log_scales[2]);
    const Vector shift = axes * Vector{x * (x * along.x), y * (y * along.y), z * (z * along.z)};
    float* mean = move.scene.means + 3 * at;
    write(vector_at(mean) + (move.numbers[NOISE_STRENGTH] * mean_rate(row)) * shift, mean);
  }
};

KERNEL __launch_bounds__(BLOCK_SIZE) move_rows(Move move) {
  const int lane = lane_number(), first = thread_number() - lane;
  if (first >= move.count) return;  // the whole warp
  const MovedRows rows(move, first);
  const Adam adam(move.numbers);
  const float* numbers = move.numbers;
  const float opacity_weight = numbers[OPACITY_WEIGHT], scale_weight = numbers[SCALE_WEIGHT];
  const auto plain = [](float gradient, int, int, float) { return gradient; };
  const auto at_rate = [&](MoveNumber which) { return [=](int, int) { return numbers[which]; }; };
  using Of = Fields<const float>;
  using To = Fields<float>;

  const uint32_t awake = rows.awake();
  rows.step(adam, &To::log_scales, &Of::log_scales, 3, ALL_LANES, [&](float gradient, int row, int, float value) {
    return scale_weight != 0 && rows.lives(row) ? gradient + scale_weight * expf(value) : gradient;
  }, at_rate(LOG_SCALES_RATE));
  __syncwarp();  // the priors above read opacities
  rows.step(adam, &To::opacity_logits, &Of::opacity_logits, 1, ALL_LANES, [&](float gradient, int row, int, float value) {
    if (opacity_weight == 0 || !rows.lives(row)) return gradient;
    const float opacity = sigmoid(value);
    return gradient + opacity_weight * (opacity * (1 - opacity));
  }, at_rate(OPACITY_LOGITS_RATE));
  if (awake) {
    rows.step(adam, &To::sh, &Of::sh, 3 * move.coefficients, awake, [&](float gradient, int, int place, float) {
      return move.sh_free[place / 3] > 0 ? gradient : 0.0f;
    }, [&](int, int place) { return move.sh_rates[place / 3]; });
    rows.step(adam, &To::means, &Of::means, 3, awake, plain, [&](int row, int) { return rows.mean_rate(row); });
    const uint32_t turned = of_all_lanes(rows.step(adam, &To::quats, &Of::quats, 4, awake, plain, at_rate(QUATS_RATE)));
    __syncwarp();
    if (turned >> lane & 1) rows.normalize(lane);
  }
  __syncwarp();
  if (rows.good && numbers[NOISE_STRENGTH] != 0 && lane < rows.rows) rows.shake(lane);
}
