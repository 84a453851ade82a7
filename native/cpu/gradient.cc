#include <cstring>

#include "gradient.h"
#include "rasterize.h"
#include "wide_gradient.h"

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
void add_moments(const Input& input, int row, const float moments[MOMENTS], const float* pulls,
                 const Gradients& gradients) {
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
  for (int k = 0; k < 2; ++k) pull[k] += pulls[k] / (ROOT_HALF_LOG2_E * ROOT_HALF_LOG2_E);
}

constexpr int AHEAD = 16;  // splats whose rows are prefetched: depth scatters them over the arrays

void expect(const Input& input, int32_t number, const Gradients& gradients) {
  const size_t row = number;
  __builtin_prefetch(input.sqrt_conics + 3 * row);
  __builtin_prefetch(input.opacities + row);
  __builtin_prefetch(gradients.means2d + 2 * row, 1);
  __builtin_prefetch(gradients.sqrt_conics + 3 * row, 1);
  __builtin_prefetch(gradients.opacities + row, 1);
  __builtin_prefetch(gradients.channels + row * input.channel_count, 1);
  if (gradients.pull) __builtin_prefetch(gradients.pull + 2 * row, 1);
}

// Adds the partials of a round's pairs to the gradients, pair after pair: the order, and so the
// result, does not depend on which thread made them.
template <int STRIDE>
void gather(const Input& input, const Binning& binning, const Round& round, const Scratch& scratch, Layout layout,
            Part part, const Gradients& gradients, Workers& workers) {
  const float* partials = scratch.partial_sums.get();
  const uint8_t* flags = scratch.flags.get();
  const int used = STRIDE == PARTIALS ? PARTIALS : layout.used;  // a constant where that is faster
  workers.ranges(round.end - round.begin, [&](int, int begin, int end) {
    for (int i = begin; i < end; ++i) {
      if (i + AHEAD < end) expect(input, binning.splats[round.begin + i + AHEAD].row, gradients);
      const int row = binning.splats[round.begin + i].row;
      float sums[STRIDE] = {};
      for (int32_t index = binning.first_pair[i]; index < binning.first_pair[i + 1]; ++index) {
        if (!flags[index]) continue;
        for (int k = 0; k < used; ++k) sums[k] += partials[static_cast<size_t>(index) * STRIDE + k];
      }
      add_moments(input, row, sums, sums + layout.pull, gradients);
      float* channels = gradients.channels + static_cast<size_t>(row) * input.channel_count + part.first;
      for (int c = 0; c < part.size; ++c) channels[c] += sums[layout.channels + c];
    }
  });
}

// Sum of w_j s_j over all splats at a pixel; see gradient.h. Alpha is counted once, with the first channels.
float all_behind(const Input& input, const Cotangents& cotangents, Part part, size_t pixel) {
  float behind = part.first == 0 ? cotangents.d_alpha[pixel] * cotangents.alpha[pixel] : 0;
  const size_t at = pixel * input.channel_count + part.first;
  for (int c = 0; c < part.size; ++c) behind += cotangents.d_sums[at + c] * cotangents.sums[at + c];
  return behind;
}

// State of a tile before its first splat.
template <int C, bool PULLED>
void start(const Input& input, const Cotangents& cotangents, Part part, const Tile& tile,
           TileGradient<C, PULLED>& state) {
  std::memset(static_cast<void*>(&state), 0, sizeof state);
  let_light_through(input, tile, state.transmittance);
  each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
    state.d_alpha[b][lane] = cotangents.d_alpha[pixel];
    state.behind[b][lane] = all_behind(input, cotangents, part, pixel);
    for (int c = 0; c < part.size; ++c) state.d_sums[c][b][lane] = cotangents.d_sums[pixel * part.size + c];
  });
}

template <int W, bool PULLED>
void start(const Input& input, const Cotangents& cotangents, Part part, const Tile& tile,
           WideGradient<W, PULLED>& state) {
  state.clear(part);
  let_light_through(input, tile, state.transmittance);
  each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
    state.d_alpha[b][lane] = part.first == 0 ? cotangents.d_alpha[pixel] : 0;
    state.behind[b][lane] = all_behind(input, cotangents, part, pixel);
    const float* from = cotangents.d_sums + pixel * input.channel_count + part.first;
    for (int c = 0; c < part.size; ++c) state.d_sums[b][c][lane] = state.d_pixels[b][lane][c] = from[c];
  });
}

// Adds the gradients that come from one part of the channels, by tile states of this type.
template <class State>
void add_part(const Input& input, const Cotangents& cotangents, const Gradients& gradients, Part part,
              Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  TileStates<State> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    const size_t pairs = binning.pair_count();
    float* partials = scratch.partial_sums.at_least(pairs * State::STRIDE);
    uint8_t* flags = scratch.flags.at_least(pairs);
    std::fill_n(flags, pairs, uint8_t{0});
    states.each_tile(workers, [&](const Tile& tile, State& state) {
      if (round.begin == 0) start(input, cotangents, part, tile, state);
      state.accumulate(input, tile, part, partials, flags);
    });
    gather<State::STRIDE>(input, binning, round, scratch, State::layout(part), part, gradients, workers);
  });
}

using AddPart = void (*)(const Input&, const Cotangents&, const Gradients&, Part, Workers&, Scratch&);

}  // namespace

void rasterize_gradient(const Input& input, const Cotangents& cotangents, const Gradients& gradients,
                        Workers& workers, Scratch& scratch, bool binned, int64_t max_pairs) {
  workers.ranges(input.count, [&](int, int begin, int end) {
    const auto clear = [&](float* array, size_t columns) {
      std::fill(array + begin * columns, array + end * columns, 0.0f);
    };
    clear(gradients.means2d, 2);
    clear(gradients.sqrt_conics, 3);
    clear(gradients.opacities, 1);
    clear(gradients.channels, input.channel_count);
    if (gradients.pull) clear(gradients.pull, 2);
  });
  Binning& binning = scratch.binning;
  if (!binned) binning.collect(input, workers, pairs_in_round(input, max_pairs));
  const bool pulled = gradients.pull != nullptr;
  if (input.channel_count <= GROUP) {
    const bool three = input.channel_count == 3;
    const AddPart plain = three ? add_part<TileGradient<3, false>> : add_part<TileGradient<GROUP, false>>;
    const AddPart with_pull = three ? add_part<TileGradient<3, true>> : add_part<TileGradient<GROUP, true>>;
    return (pulled ? with_pull : plain)(input, cotangents, gradients, {0, input.channel_count}, workers, scratch);
  }
  const int width = walk_width(input, binning, max_pairs);
  const bool wide = width == WIDE_WALK;
  const AddPart plain = wide ? add_part<WideGradient<WIDE_WALK, false>> : add_part<WideGradient<NARROW_WALK, false>>;
  const AddPart with_pull = wide ? add_part<WideGradient<WIDE_WALK, true>> : add_part<WideGradient<NARROW_WALK, true>>;
  const AddPart add = pulled ? with_pull : plain;
  each_part_of_channels(input, width, [&](Part part) { add(input, cotangents, gradients, part, workers, scratch); });
}

}  // namespace splatax
