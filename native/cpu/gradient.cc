#include <cstring>

#include "gradient.h"
#include "rasterize.h"

namespace splatax {
namespace {

// Adds the contributions of a splat's pairs to its gradients.
//
// With t = u dx + v dy, s = w dy and alpha = o exp(-(t^2 + s^2) / 2), and sums over pixels of g:
//
//   dL/du = -sum g t dx = -(u gxx + v gxy)        dL/dx = sum g t u = u (u gx + v gy)
//   dL/dv = -sum g t dy = -(u gxy + v gyy)        dL/dy = sum g (t v + s w) = v (u gx + v gy) + w^2 gy
//   dL/dw = -sum g s dy = -w gyy                  dL/do = sum g / o
//
// where the moments gx ... are about the splat's mean. With `pull`, each pixel's part of dL/dx and
// dL/dy has counted by its absolute value too, from (u, v, w) sqrt(log2(e) / 2): see `Splat`.
void add_moments(const Input& input, int row, const float moments[PARTIALS], const Gradients& gradients) {
  const float* root = input.sqrt_conics + 3 * static_cast<size_t>(row);
  const float u = root[0], v = root[1], w = root[2];
  const float gx = moments[1], gy = moments[2], gxx = moments[3], gxy = moments[4], gyy = moments[5];
  const float along = u * gx + v * gy;
  float* d_mean = gradients.means2d + 2 * static_cast<size_t>(row);
  float* d_root = gradients.sqrt_conics + 3 * static_cast<size_t>(row);
  d_mean[0] += u * along;
  d_mean[1] += v * along + w * w * gy;
  d_root[0] -= u * gxx + v * gxy;
  d_root[1] -= u * gxy + v * gyy;
  d_root[2] -= w * gyy;
  gradients.opacities[row] += moments[0] / input.opacities[row];
  if (!gradients.pull) return;
  float* pull = gradients.pull + 2 * static_cast<size_t>(row);
  for (int k = 0; k < 2; ++k) pull[k] += moments[PULL + k] / (ROOT_HALF_LOG2_E * ROOT_HALF_LOG2_E);
}

// Adds the partials of a round's pairs to the gradients, pair after pair: the order, and so the
// result, does not depend on which thread made them.
void gather(const Input& input, const Binning& binning, const Round& round, const float (*partials)[PARTIALS],
            const uint8_t* flags, int first, int size, const Gradients& gradients, Workers& workers) {
  workers.ranges(round.end - round.begin, [&](int, int begin, int end) {
    for (int i = begin; i < end; ++i) {
      const int row = binning.splats[round.begin + i].row;
      float sums[PARTIALS] = {};
      for (int32_t index = binning.first_pair[i]; index < binning.first_pair[i + 1]; ++index) {
        if (!flags[index]) continue;
        for (int k = 0; k < PARTIALS; ++k) sums[k] += partials[index][k];
      }
      add_moments(input, row, sums, gradients);
      float* channels = gradients.channels + static_cast<size_t>(row) * input.channel_count + first;
      for (int c = 0; c < size; ++c) channels[c] += sums[MOMENTS + c];
    }
  });
}

// State of a tile before its first splat.
template <int C, bool PULLED>
void start(const Input& input, const Cotangents& cotangents, int first, int size, const Tile& tile,
           TileGradient<C, PULLED>& state) {
  std::memset(static_cast<void*>(&state), 0, sizeof state);
  let_light_through(input, tile, state.transmittance);
  each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
    // Alpha is counted once, with the first channels.
    state.d_alpha[b][lane] = first == 0 ? cotangents.d_alpha[pixel] : 0;
    float behind = state.d_alpha[b][lane] * cotangents.alpha[pixel];
    for (int c = 0; c < size; ++c) {
      const size_t at = pixel * input.channel_count + first + c;
      state.d_sums[c][b][lane] = cotangents.d_sums[at];
      behind += cotangents.d_sums[at] * cotangents.sums[at];
    }
    state.behind[b][lane] = behind;
  });
}

// Adds the gradients that come from channels [first, first + size).
template <int C, bool PULLED>
void add_group(const Input& input, const Cotangents& cotangents, const Gradients& gradients, int first,
               int size, Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  binning.load_channels(input, first, size, workers);
  TileStates<TileGradient<C, PULLED>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    const size_t pairs = binning.pair_count();
    auto* partials = reinterpret_cast<float(*)[PARTIALS]>(scratch.partial_sums.at_least(pairs * PARTIALS));
    uint8_t* flags = scratch.flags.at_least(pairs);
    std::fill_n(flags, pairs, uint8_t{0});
    states.each_tile(workers, [&](const Tile& tile, TileGradient<C, PULLED>& state) {
      if (round.begin == 0) start(input, cotangents, first, size, tile, state);
      state.accumulate(tile, partials, flags);
    });
    gather(input, binning, round, partials, flags, first, size, gradients, workers);
  });
}

}  // namespace

void rasterize_gradient(const Input& input, const Cotangents& cotangents, const Gradients& gradients,
                        Workers& workers, Scratch& scratch, bool binned, int64_t max_pairs) {
  workers.ranges(input.count, [&](int, int begin, int end) {
    const auto clear = [&](float* array, size_t columns) {
      std::fill(array + begin * columns, array + end * columns, 0.0f);
    };
    clear(gradients.means2d, 2), clear(gradients.sqrt_conics, 3), clear(gradients.opacities, 1);
    clear(gradients.channels, input.channel_count);
    if (gradients.pull) clear(gradients.pull, 2);
  });
  if (!binned) scratch.binning.collect(input, workers, max_pairs);
  each_group(input.channel_count, [&](int first, int size) {
    const auto plain = size == 3 ? add_group<3, false> : add_group<GROUP, false>;
    const auto pulled = size == 3 ? add_group<3, true> : add_group<GROUP, true>;
    const auto add = gradients.pull ? pulled : plain;
    add(input, cotangents, gradients, first, size, workers, scratch);
  });
}

}  // namespace splatax
