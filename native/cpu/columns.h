// Sixteen rows of a few numbers, as columns: transposes arrays of vectors to lanes and back.
//
// Blocks of four by four numbers are transposed in registers. Gather and scatter instructions are no
// faster, and on some machines much slower.
#pragma once

#include "lanes.h"
#include "vectors.h"

namespace splatax {

typedef float Four __attribute__((vector_size(16)));

SPLATAX_INLINE Four load_four(const float* from) {
  Four result;
  std::memcpy(&result, from, sizeof result);
  return result;
}
SPLATAX_INLINE void store_four(float* to, Four a) { std::memcpy(to, &a, sizeof a); }

// Row i of the result is column i of the four rows.
SPLATAX_INLINE void transpose(Four& a, Four& b, Four& c, Four& d) {
  const Four ab = __builtin_shufflevector(a, b, 0, 4, 1, 5), cd = __builtin_shufflevector(c, d, 0, 4, 1, 5);
  const Four AB = __builtin_shufflevector(a, b, 2, 6, 3, 7), CD = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  a = __builtin_shufflevector(ab, cd, 0, 1, 4, 5), b = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
  c = __builtin_shufflevector(AB, CD, 0, 1, 4, 5), d = __builtin_shufflevector(AB, CD, 2, 3, 6, 7);
}

// Up to MAX columns of sixteen rows.
template <int MAX>
class Columns {
 public:
  Columns() {}
  // Reads rows of `width` numbers each; rows past `count` repeat the last one.
  Columns(const float* rows, int width, int count) { read(rows, width, count); }

  SPLATAX_INLINE Lanes operator[](int k) const { return load(values_[k]); }
  SPLATAX_INLINE Vector vector(int k) const { return {load(values_[k]), load(values_[k + 1]), load(values_[k + 2])}; }
  SPLATAX_INLINE void set(int k, Lanes column) { store(values_[k], column); }
  SPLATAX_INLINE void set(int k, const Vector& columns) {
    store(values_[k], columns.x), store(values_[k + 1], columns.y), store(values_[k + 2], columns.z);
  }

  SPLATAX_INLINE void read(const float* rows, int width, int count) {
    const int whole = count == LANES ? width / 4 * 4 : 0;
    for (int k = 0; k < whole; k += 4) {
      for (int lane = 0; lane < LANES; lane += 4) {
        const float* row = rows + lane * width + k;
        Four a = load_four(row), b = load_four(row + width);
        Four c = load_four(row + 2 * width), d = load_four(row + 3 * width);
        transpose(a, b, c, d);
        store_four(values_[k] + lane, a), store_four(values_[k + 1] + lane, b);
        store_four(values_[k + 2] + lane, c), store_four(values_[k + 3] + lane, d);
      }
    }
    for (int k = whole; k < width; ++k) {
      for (int lane = 0; lane < LANES; ++lane) {
        values_[k][lane] = rows[(lane < count ? lane : count - 1) * width + k];
      }
    }
  }

  // Writes the first `count` rows of `width` numbers each.
  SPLATAX_INLINE void write(float* rows, int width, int count) const {
    const int whole = count == LANES ? width / 4 * 4 : 0;
    for (int k = 0; k < whole; k += 4) {
      for (int lane = 0; lane < LANES; lane += 4) {
        Four a = load_four(values_[k] + lane), b = load_four(values_[k + 1] + lane);
        Four c = load_four(values_[k + 2] + lane), d = load_four(values_[k + 3] + lane);
        transpose(a, b, c, d);
        float* row = rows + lane * width + k;
        store_four(row, a), store_four(row + width, b);
        store_four(row + 2 * width, c), store_four(row + 3 * width, d);
      }
    }
    for (int k = whole; k < width; ++k) {
      for (int lane = 0; lane < count; ++lane) rows[lane * width + k] = values_[k][lane];
    }
  }

 private:
  alignas(64) float values_[MAX][LANES];
};

SPLATAX_INLINE Lanes read_numbers(const float* numbers, int count) { return Columns<1>(numbers, 1, count)[0]; }
SPLATAX_INLINE Vector read_vectors(const float* rows, int count) { return Columns<3>(rows, 3, count).vector(0); }
SPLATAX_INLINE void write_numbers(Lanes values, float* numbers, int count) {
  Columns<1> column;
  column.set(0, values);
  column.write(numbers, 1, count);
}
SPLATAX_INLINE void write_pairs(Lanes x, Lanes y, float* rows, int count) {
  Columns<2> columns;
  columns.set(0, x), columns.set(1, y);
  columns.write(rows, 2, count);
}
SPLATAX_INLINE void write_vectors(const Vector& values, float* rows, int count) {
  Columns<3> columns;
  columns.set(0, values);
  columns.write(rows, 3, count);
}

}  // namespace splatax
