// From rows of the input to `Splat`s: sixteen at a time.
#pragma once

#include "columns.h"
#include "logarithm.h"
#include "splats.h"

namespace splatax {

// The boxes and fields of sixteen rows, of which `drawn` has a bit for each that reaches the centre of a pixel.
class Prepared {
 public:
  uint32_t drawn;

  Prepared(const Input& input, int first, int count) : input_(input), first_(first), count_(count) {
    const size_t row = first;
    const Columns<2> extents(input.extents + 2 * row, 2, count);
    // Conditions are written so that NaN is culled: `max` and `min` return the second number if there is one.
    const Mask has_box = (broadcast(0) < extents[0]) & (broadcast(0) < extents[1]);
    drawn = 0;
    if (!any(has_box)) return;
    const Columns<2> means(input.means2d + 2 * row, 2, count);
    const Lanes opacity = read_numbers(input.opacities + row, count);
    const Lanes zero = broadcast(0), size[] = {broadcast(input.width - 1.0f), broadcast(input.height - 1.0f)};
    Mask inside = has_box & (broadcast(MIN_ALPHA) <= opacity);
    for (int axis = 0; axis < 2; ++axis) {
      const Lanes low = max(zero, ceil(means[axis] - extents[axis] - 0.5f));
      const Lanes high = min(size[axis], floor(means[axis] + extents[axis] - 0.5f));
      inside = inside & (low <= high);
      store(tiles_[axis], low * broadcast(1.0f / TILE));
      store(tiles_[2 + axis], high * broadcast(1.0f / TILE));
    }
    drawn = bits(inside) & ((1u << count) - 1);
    if (drawn) fill(means, opacity);
  }

  // Writes the rows that are drawn, in order, and calls each(row) for them.
  template <class Each>
  void write(Splat* to, const Each& each) const {
    Splat spare;
    float* rows[LANES];
    for (float*& row : rows) row = &spare.x;
    for (uint32_t left = drawn; left; left &= left - 1, ++to) {
      const int lane = __builtin_ctz(left);
      rows[lane] = &to->x;
      to->row = first_ + lane;
      to->first_column = static_cast<uint16_t>(tiles_[0][lane]);
      to->last_column = static_cast<uint16_t>(tiles_[2][lane]);
      to->first_row = static_cast<uint16_t>(tiles_[1][lane]);
      to->last_row = static_cast<uint16_t>(tiles_[3][lane]);
      each(first_ + lane);
    }
    const auto put = [&](int from, int columns) {
      write_columns([&](int k) { return fields_[from + k]; }, columns, [&](int lane) { return rows[lane] + from; });
    };
    put(0, 4);
    put(4, 4);
    put(8, 4);
    put(12, 1);
  }

 private:
  // Fills in the floats of `Splat`, in its order.
  void fill(const Columns<2>& means, Lanes opacity) {
    const Columns<3> roots(input_.sqrt_conics + 3 * static_cast<size_t>(first_), 3, count_);
    const Lanes u = ROOT_HALF_LOG2_E * roots[0], v = ROOT_HALF_LOG2_E * roots[1], w = ROOT_HALF_LOG2_E * roots[2];
    const Lanes level = log2(opacity), reach = multiply_add(level - LOG2_MIN_ALPHA, broadcast(1.001f), broadcast(1e-3f));
    const Lanes columns[] = {means[0], means[1], u, v, w, level, reach, quotient(-v, u), quotient(-u * v, multiply_add(v, v, w * w))};
    for (int k = 0; k < 9; ++k) store(fields_[k], columns[k]);
    const int channels = input_.channel_count;
    Columns<GROUP> own;
    if (channels <= GROUP && channels > 0) own.read(input_.channels + static_cast<size_t>(first_) * channels, channels, count_);
    for (int c = 0; c < GROUP; ++c) store(fields_[9 + c], c < channels && channels <= GROUP ? own[c] : broadcast(0));
  }

  // a / b, or 0 where b is 0.
  static SPLATAX_INLINE Lanes quotient(Lanes a, Lanes b) {
    const Mask none = (b <= broadcast(0)) & (broadcast(0) <= b);
    return where(none, broadcast(0), a / where(none, broadcast(1), b));
  }

  const Input& input_;
  const int first_, count_;
  alignas(64) float tiles_[4][LANES];    // first column and row, last column and row
  alignas(64) float fields_[13][LANES];  // those of `Splat`, from `x` to the last channel
};

}  // namespace splatax
