// Sixteen rows of a few numbers, as columns: transposes arrays of vectors to lanes and back.
//
// Blocks of four by four numbers are transposed in registers. Gather and scatter instructions are no
// faster, and on some machines much slower.
#pragma once

#include <algorithm>

#include "lanes.h"
#include "vectors.h"

namespace splatax {

#if defined(__AVX512F__)

// Four rows of four numbers in each register, whose parts of four are transposed at once: of rows i, i + 4, i + 8 and
// i + 12 in register i, part p becomes the rows 4 p to 4 p + 3 of the columns, which is the order of lanes.
SPLATAX_INLINE void transpose_parts(__m512 (&r)[4]) {
  const __m512 ab = _mm512_unpacklo_ps(r[0], r[1]), cd = _mm512_unpacklo_ps(r[2], r[3]);
  const __m512 AB = _mm512_unpackhi_ps(r[0], r[1]), CD = _mm512_unpackhi_ps(r[2], r[3]);
  r[0] = _mm512_shuffle_ps(ab, cd, 0x44);
  r[1] = _mm512_shuffle_ps(ab, cd, 0xee);
  r[2] = _mm512_shuffle_ps(AB, CD, 0x44);
  r[3] = _mm512_shuffle_ps(AB, CD, 0xee);
}

// Reads `width` numbers, at most four, at row_at(lane) for each lane, and stores them as columns to to(k).
template <class RowAt, class To>
SPLATAX_INLINE void read_columns(const RowAt& row_at, int width, const To& to) {
  const __mmask8 mask = static_cast<__mmask8>((1u << width) - 1);
  const auto four = [&](int lane) { return width == 4 ? _mm_loadu_ps(row_at(lane)) : _mm_maskz_loadu_ps(mask, row_at(lane)); };
  __m512 r[4];
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) {
    r[i] = _mm512_insertf32x4(_mm512_castps128_ps512(four(i)), four(i + 4), 1);
    r[i] = _mm512_insertf32x4(_mm512_insertf32x4(r[i], four(i + 8), 2), four(i + 12), 3);
  }
  transpose_parts(r);
#pragma GCC unroll 4
  for (int k = 0; k < 4; ++k) {
    if (k < width) _mm512_storeu_ps(to(k), r[k]);
  }
}

// Writes `width` columns, at most four, from from(k) to the rows at row_at(lane).
template <class From, class RowAt>
SPLATAX_INLINE void write_columns(const From& from, int width, const RowAt& row_at) {
  const __mmask8 mask = static_cast<__mmask8>((1u << width) - 1);
  __m512 r[4];
#pragma GCC unroll 4
  for (int k = 0; k < 4; ++k) r[k] = _mm512_loadu_ps(from(k < width ? k : 0));
  transpose_parts(r);
  const auto put = [&](int lane, __m128 row) {
    width == 4 ? _mm_storeu_ps(row_at(lane), row) : _mm_mask_storeu_ps(row_at(lane), mask, row);
  };
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) {
    put(i, _mm512_castps512_ps128(r[i]));
    put(i + 4, _mm512_extractf32x4_ps(r[i], 1));
    put(i + 8, _mm512_extractf32x4_ps(r[i], 2));
    put(i + 12, _mm512_extractf32x4_ps(r[i], 3));
  }
}

#else

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
  a = __builtin_shufflevector(ab, cd, 0, 1, 4, 5);
  b = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
  c = __builtin_shufflevector(AB, CD, 0, 1, 4, 5);
  d = __builtin_shufflevector(AB, CD, 2, 3, 6, 7);
}

// Reads `width` numbers, at most four, at row_at(lane) for each lane, and stores them as columns to to(k).
template <class RowAt, class To>
SPLATAX_INLINE void read_columns(const RowAt& row_at, int width, const To& to) {
  for (int lane = 0; lane < LANES; lane += 4) {
    if (width == 4) {
      Four a = load_four(row_at(lane)), b = load_four(row_at(lane + 1));
      Four c = load_four(row_at(lane + 2)), d = load_four(row_at(lane + 3));
      transpose(a, b, c, d);
      store_four(to(0) + lane, a);
      store_four(to(1) + lane, b);
      store_four(to(2) + lane, c);
      store_four(to(3) + lane, d);
    } else {
      for (int k = 0; k < width; ++k) {
        for (int i = lane; i < lane + 4; ++i) to(k)[i] = row_at(i)[k];
      }
    }
  }
}

// Writes `width` columns, at most four, from from(k) to the rows at row_at(lane).
template <class From, class RowAt>
SPLATAX_INLINE void write_columns(const From& from, int width, const RowAt& row_at) {
  for (int lane = 0; lane < LANES; lane += 4) {
    if (width == 4) {
      Four a = load_four(from(0) + lane), b = load_four(from(1) + lane);
      Four c = load_four(from(2) + lane), d = load_four(from(3) + lane);
      transpose(a, b, c, d);
      store_four(row_at(lane), a);
      store_four(row_at(lane + 1), b);
      store_four(row_at(lane + 2), c);
      store_four(row_at(lane + 3), d);
    } else {
      for (int i = lane; i < lane + 4; ++i) {
        for (int k = 0; k < width; ++k) row_at(i)[k] = from(k)[i];
      }
    }
  }
}

#endif

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
    store(values_[k], columns.x);
    store(values_[k + 1], columns.y);
    store(values_[k + 2], columns.z);
  }

  SPLATAX_INLINE void read(const float* rows, int width, int count) {
    if (count == LANES) {
      each_four(width, [&](int k, int columns) {
        read_columns([&](int lane) { return rows + lane * width + k; }, columns, [&](int c) { return values_[k + c]; });
      });
      return;
    }
    const float* at[LANES];
    for (int lane = 0; lane < LANES; ++lane) at[lane] = place(rows, std::min(lane, count - 1), width);
    read_at(at, width);
  }

  // Reads rows of an array by their numbers.
  SPLATAX_INLINE void read(const float* array, int width, const int32_t* numbers, int count) {
    const float* at[LANES];
    for (int lane = 0; lane < LANES; ++lane) at[lane] = place(array, numbers[std::min(lane, count - 1)], width);
    read_at(at, width);
  }

  // Writes the first `count` rows of `width` numbers each.
  SPLATAX_INLINE void write(float* rows, int width, int count) const {
    if (count == LANES) {
      each_four(width, [&](int k, int columns) {
        write_columns([&](int c) { return values_[k + c]; }, columns, [&](int lane) { return rows + lane * width + k; });
      });
      return;
    }
    for (int k = 0; k < width; ++k) {
      for (int lane = 0; lane < count; ++lane) rows[lane * width + k] = values_[k][lane];
    }
  }

 private:
  // The first number of a row. Compilers would compute sixteen places in vector registers, and take them out one by one.
  static SPLATAX_INLINE const float* place(const float* rows, int row, int width) {
    const float* at = rows + row * static_cast<size_t>(width);
    asm("" : "+r"(at));
    return at;
  }

  SPLATAX_INLINE void read_at(const float* const (&at)[LANES], int width) {
    each_four(width, [&](int k, int columns) {
      read_columns([&](int lane) { return at[lane] + k; }, columns, [&](int c) { return values_[k + c]; });
    });
  }

  // Calls body(k, columns) for each four columns, and for those that are left over.
  template <class Body>
  static SPLATAX_INLINE void each_four(int width, const Body& body) {
    int k = 0;
    for (; k + 4 <= width; k += 4) body(k, 4);
    if (k < width) body(k, width - k);
  }

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
  columns.set(0, x);
  columns.set(1, y);
  columns.write(rows, 2, count);
}
SPLATAX_INLINE void write_vectors(const Vector& values, float* rows, int count) {
  Columns<3> columns;
  columns.set(0, values);
  columns.write(rows, 3, count);
}

}  // namespace splatax
