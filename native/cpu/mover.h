// The step of sixteen Gaussians: priors, Adam, unit quaternions, and noise in the means. Only moving.cc includes this file.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "columns.h"
#include "harmonics.h"
#include "moving.h"
#include "normals.h"

namespace splatax {

constexpr float SHARPNESS = 100, FAINT = 0.005f, NOISELESS = 0.17135532f;  // as in splatax/moving.py
constexpr float NOTHING = -std::numeric_limits<float>::infinity();         // logit of an empty slot
constexpr float FADED = 0x1p-20f;                                          // as in splatax/moving.py

SPLATAX_INLINE Mask is_zero(Lanes a) { return (a <= broadcast(0)) & (broadcast(0) <= a); }
SPLATAX_INLINE bool all(Mask mask) { return bits(mask) == (1u << LANES) - 1; }
SPLATAX_INLINE Lanes exponential(Lanes x) { return exp2(max(min(LOG2_E * x, broadcast(100)), broadcast(-100))); }
SPLATAX_INLINE Lanes sigmoid(Lanes x) { return broadcast(1) / (exponential(-x) + 1); }

// Sixteen numbers of a field and of what belongs to it.
struct Place {
  float* values;
  const float* gradients;
  float *means, *squares;
};

// Moves sixteen rows at a time.
class Mover {
 public:
  Mover(const Move& move, const Fields<const float>& gradients)
      : move_(move),
        gradients_(gradients),
        good_(number(GOOD) != 0),
        decay_(broadcast(number(MEAN_DECAY))),
        rest_(broadcast(number(MEAN_REST))),
        square_decay_(broadcast(number(SQUARE_DECAY))),
        square_rest_(broadcast(number(SQUARE_REST))) {
    const auto rate = [&](MoveNumber which) { return good_ ? number(which) : 0; };
    std::fill_n(quat_rates_, 4 * LANES, rate(QUATS_RATE));
    std::fill_n(scale_rates_, 3 * LANES, rate(LOG_SCALES_RATE));
    std::fill_n(opacity_rates_, LANES, rate(OPACITY_LOGITS_RATE));
    std::fill_n(mean_rates_, 3 * LANES, good_ ? *move.mean_rates : 0);
    for (int i = 0; i < LANES * 3 * move.coefficients; ++i) {
      const int k = i / 3 % move.coefficients;
      sh_rates_[i] = good_ ? move.sh_rates[k] : 0;
      sh_free_[i] = move.sh_free[k];
    }
  }

  // Prefetches the moments of rows that are scattered over the scene.
  void expect(int first, int count, const uint8_t* seen) const {
    constexpr int LINE = 16;  // floats
    const int numbers = 3 * move_.coefficients;
    for (int i = 0; i < count; ++i) {
      if (!seen[i]) continue;
      const size_t row = static_cast<size_t>(first) + i;
      for (const Fields<float>& moments : {move_.mean, move_.square}) {
        for (int k = 0; k < numbers; k += LINE) __builtin_prefetch(moments.sh + numbers * row + k, 1);
        __builtin_prefetch(moments.quats + 4 * row, 1);
        __builtin_prefetch(moments.means + 3 * row, 1);
      }
    }
  }

  // Takes other gradients from here on.
  void follow(const Fields<const float>& gradients) { gradients_ = gradients; }

  // Moves rows. `seen` tells which of them have a gradient at all; without it, the gradients do.
  void run(int first, int count, const uint8_t* seen) {
    const size_t row = first;
    alignas(64) float lives[LANES] = {};
    if (number(SCALE_WEIGHT) != 0 || number(OPACITY_WEIGHT) != 0) {
      for (int lane = 0; lane < count; ++lane) lives[lane] = move_.scene.opacity_logits[row + lane] > NOTHING;
    }
    const auto scale_prior = [&](int at, const float* values) {
      if (!(number(SCALE_WEIGHT) != 0)) return broadcast(0);
      alignas(64) float living[LANES];
      for (int i = 0; i < LANES; ++i) living[i] = at + i < 3 * count ? lives[(at + i) / 3] : 0;
      return or_zero(broadcast(0) < load(living), number(SCALE_WEIGHT) * exponential(load(values)));
    };
    const auto opacity_prior = [&](int, const float* values) {
      if (!(number(OPACITY_WEIGHT) != 0)) return broadcast(0);
      const Lanes opacity = sigmoid(load(values));
      return or_zero(broadcast(0) < load(lives), number(OPACITY_WEIGHT) * (opacity * (1 - opacity)));
    };
    field(&Fields<float>::log_scales, &Fields<const float>::log_scales, row, 3, count, scale_rates_, nullptr, scale_prior);
    field(&Fields<float>::opacity_logits, &Fields<const float>::opacity_logits, row, 1, count, opacity_rates_, nullptr,
          opacity_prior);
    const uint32_t awake = awake_rows(row, count, seen);
    if (awake == (1u << count) - 1) {
      move_awake(row, count);
    } else {
      for (uint32_t left = awake; left; left &= left - 1) move_one(row + __builtin_ctz(left));
    }
    if (good_ && number(NOISE_STRENGTH) != 0) shake(row, count);
  }

 private:
  float number(MoveNumber which) const { return move_.numbers[which]; }

  // Bits of the rows of which more than opacity and scales moves: the mean of the gradient of their centres is not zero, or
  // they have a gradient.
  uint32_t awake_rows(size_t row, int count, const uint8_t* seen) const {
    const auto some = [](const float* numbers, int size) {
      return std::any_of(numbers, numbers + size, [](float number) { return number != 0; });
    };
    const int coefficients = move_.coefficients;
    uint32_t awake = 0;
    for (int lane = 0; lane < count; ++lane) {
      const size_t own = row + lane;
      const float* mean = move_.mean.means + 3 * own;
      bool moves = (mean[0] != 0) | (mean[1] != 0) | (mean[2] != 0);
      if (!moves && good_ && (!seen || seen[lane])) {
        moves = some(gradients_.means + 3 * own, 3) || some(gradients_.quats + 4 * own, 4) || sh_fed(own, coefficients);
      }
      awake |= static_cast<uint32_t>(moves) << lane;
    }
    return awake;
  }

  // Returns whether a harmonic that is learned already has a gradient.
  bool sh_fed(size_t row, int coefficients) const {
    const float* numbers = gradients_.sh + 3 * coefficients * row;
    bool fed = false;
    for (int i = 0; i < 3 * coefficients; ++i) fed |= sh_free_[i] > 0 && numbers[i] != 0;
    return fed;
  }

  // Moves centres, harmonics and quaternions of rows.
  void move_awake(size_t row, int count) {
    const auto no_prior = [](int, const float*) { return broadcast(0); };
    if (move_.rate_for_each_row && good_) {
      for (int i = 0; i < count; ++i) std::fill_n(mean_rates_ + 3 * i, 3, move_.mean_rates[row + i]);
    }
    field(&Fields<float>::sh, &Fields<const float>::sh, row, 3 * move_.coefficients, count, sh_rates_, sh_free_, no_prior);
    field(&Fields<float>::means, &Fields<const float>::means, row, 3, count, mean_rates_, nullptr, no_prior);
    const Columns<4> before(move_.scene.quats + 4 * row, 4, count);
    field(&Fields<float>::quats, &Fields<const float>::quats, row, 4, count, quat_rates_, nullptr, no_prior);
    normalize(before, row, count);
  }

  // Moves centre, harmonics and quaternion of one row, to the same bits.
  void move_one(size_t row) {
    const auto no_prior = [](int, const float*) { return broadcast(0); };
    field(&Fields<float>::sh, &Fields<const float>::sh, row, 3 * move_.coefficients, 1, sh_rates_, sh_free_, no_prior);
    alignas(64) float rates[LANES] = {}, values[LANES] = {}, gradients[LANES] = {}, means[LANES] = {}, squares[LANES] = {};
    std::fill_n(rates, 3, move_.rate_for_each_row && good_ ? move_.mean_rates[row] : mean_rates_[0]);
    std::copy_n(quat_rates_, 4, rates + 3);
    const auto gather = [&](const auto& from, float* to) {
      std::copy_n(from.means + 3 * row, 3, to), std::copy_n(from.quats + 4 * row, 4, to + 3);
    };
    const auto scatter = [&](const float* from, const Fields<float>& to) {
      std::copy_n(from, 3, to.means + 3 * row), std::copy_n(from + 3, 4, to.quats + 4 * row);
    };
    gather(move_.scene, values);
    gather(gradients_, gradients);
    gather(move_.mean, means);
    gather(move_.square, squares);
    adam({values, gradients, means, squares}, 0, rates, nullptr, no_prior);
    float* const quat = values + 3;
    if (!std::equal(quat, quat + 4, move_.scene.quats + 4 * row)) {
      float squared = 0;
      for (int k = 0; k < 4; ++k) squared = squared + quat[k] * quat[k];
      const float length = std::sqrt(squared);
      for (int k = 0; k < 4; ++k) quat[k] = squared <= 0 ? 0 : quat[k] / length;
    }
    scatter(values, move_.scene);
    scatter(means, move_.mean);
    scatter(squares, move_.square);
  }

  // Makes a step of Adam with one field of some rows. `prior` gives the gradients that a prior adds to vector `at`.
  template <class Prior>
  SPLATAX_INLINE void field(float* Fields<float>::*own, const float* Fields<const float>::*of, size_t row, int width, int count,
                            const float* rates, const float* free, const Prior& prior) {
    const size_t begin = row * width;
    const Place place{move_.scene.*own + begin, gradients_.*of + begin, move_.mean.*own + begin, move_.square.*own + begin};
    const int numbers = width * count;
    for (int at = 0; at + LANES <= numbers; at += LANES) {
      adam({place.values + at, place.gradients + at, place.means + at, place.squares + at}, at, rates, free, prior);
    }
    const int whole = numbers / LANES * LANES, left = numbers - whole;
    if (left == 0) return;
    alignas(64) float values[LANES] = {}, gradients[LANES] = {}, means[LANES] = {}, squares[LANES] = {};
    std::copy_n(place.values + whole, left, values), std::copy_n(place.gradients + whole, left, gradients);
    std::copy_n(place.means + whole, left, means), std::copy_n(place.squares + whole, left, squares);
    adam({values, gradients, means, squares}, whole, rates, free, prior);
    std::copy_n(values, left, place.values + whole);
    std::copy_n(means, left, place.means + whole), std::copy_n(squares, left, place.squares + whole);
  }

  // Numbers at rest are not written, and their squares not read.
  template <class Prior>
  SPLATAX_INLINE void adam(const Place& place, int at, const float* rates, const float* free, const Prior& prior) const {
    Lanes gradient = broadcast(0);
    if (good_) {
      gradient = load(place.gradients);
      if (free) gradient = or_zero(broadcast(0) < load(free + at), gradient);
      gradient = gradient + prior(at, place.values);
    }
    Lanes mean = load(place.means);
    const Mask unfed = is_zero(gradient), rests = unfed & is_zero(mean);
    if (all(rests)) return;
    const Lanes before = load(place.squares), values = load(place.values);
    const Lanes square = where(rests, before, square_decay_ * before + square_rest_ * (gradient * gradient));
    mean = decay_ * mean + rest_ * gradient;
    const Lanes length = sqrt(square * broadcast(number(SQUARE_CORRECTION))) + number(EPSILON);
    const Lanes step = (mean * broadcast(number(MEAN_CORRECTION))) / length;
    const Mask faded = unfed & (absolute(step) <= broadcast(FADED));
    store(place.squares, square);
    store(place.means, where(faded, broadcast(0), mean));
    store(place.values, where(faded, values, values - load(rates + at) * step));
  }

  // Normalizes the quaternions that differ from those before.
  void normalize(const Columns<4>& before, size_t row, int count) {
    float* const rows = move_.scene.quats + 4 * row;
    Columns<4> quats(rows, 4, count);
    Mask same = is_zero(broadcast(0));
    Lanes squared = broadcast(0);
    for (int k = 0; k < 4; ++k) {
      same = same & (before[k] <= quats[k]) & (quats[k] <= before[k]);
      squared = squared + quats[k] * quats[k];
    }
    if (all(same)) return;
    const Lanes length = sqrt(squared);
    for (int k = 0; k < 4; ++k) {
      const Lanes unit = where(squared <= broadcast(0), broadcast(0), quats[k] / length);
      quats.set(k, where(same, quats[k], unit));
    }
    quats.write(rows, 4, count);
  }

  // Adds noise to the means of faint Gaussians, by their covariance; see `splatax.moving.shaken`.
  void shake(size_t row, int count) {
    const Lanes logit = read_numbers(move_.scene.opacity_logits + row, count);
    const Lanes opacity = sigmoid(logit);
    const Mask open = (broadcast(NOTHING) < logit) & (opacity < broadcast(NOISELESS));
    if (!any(open)) return;
    const Lanes gate = broadcast(1) / (exponential(SHARPNESS * (min(opacity, broadcast(NOISELESS)) - FAINT)) + 1);
    const size_t number_of_block = row / move_.block, place = row % move_.block;
    alignas(64) float drawn[3 * LANES];
    normals(move_.keys + 2 * number_of_block, 3 * place, drawn);
    Vector noise = Columns<3>(drawn, 3, LANES).vector(0);
    noise = gate * noise;

    const Columns<4> quats(move_.scene.quats + 4 * row, 4, count);
    Lanes squared = broadcast(0);
    for (int k = 0; k < 4; ++k) squared = squared + quats[k] * quats[k];
    const Mask turned = broadcast(0) < squared;
    const Lanes inverse = broadcast(1) / sqrt(where(turned, squared, broadcast(1)));
    Lanes unit[4];
    for (int k = 0; k < 4; ++k) unit[k] = or_zero(turned, quats[k] * inverse);
    const Lanes w = unit[0], x = unit[1], y = unit[2], z = unit[3];
    const Matrix turn{{{1 - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)},
                       {2.0f * (x * y - w * z), 1 - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)},
                       {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1 - 2.0f * (x * x + y * y)}}};
    const Columns<3> log_scales(move_.scene.log_scales + 3 * row, 3, count);
    Vector along = transposed_times(turn, noise);
    Lanes* const parts[3] = {&along.x, &along.y, &along.z};
    for (int k = 0; k < 3; ++k) {
      const Lanes scale = number(PER_EXTENT) * exponential(log_scales[k]);
      *parts[k] = scale * (scale * *parts[k]);
    }
    const Lanes rates = move_.rate_for_each_row ? read_numbers(move_.mean_rates + row, count) : broadcast(*move_.mean_rates);
    const Vector shift = or_zero(open, (number(NOISE_STRENGTH) * rates) * (turn * along));
    float* const means = move_.scene.means + 3 * row;
    write_vectors(read_vectors(means, count) + shift, means, count);
  }

  const Move& move_;
  Fields<const float> gradients_;
  const bool good_;
  const Lanes decay_, rest_, square_decay_, square_rest_;
  alignas(64) float quat_rates_[4 * LANES], scale_rates_[3 * LANES], opacity_rates_[LANES], mean_rates_[3 * LANES];
  alignas(64) float sh_rates_[3 * MAX_COEFFICIENTS * LANES], sh_free_[3 * MAX_COEFFICIENTS * LANES];
};

}  // namespace splatax
