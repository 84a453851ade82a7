// Rows of splats that are kept in lanes, as floats between 2 and infinity: XLA's threads flush smaller ones to zero.
#pragma once

#include <cstdint>
#include <cstring>

namespace splatax {

constexpr uint32_t MARK = 0x40000000;

inline float marked(int32_t row) {
  const uint32_t bits = MARK + static_cast<uint32_t>(row);
  float result;
  std::memcpy(&result, &bits, sizeof result);
  return result;
}

// Returns -1 for zero.
inline int32_t row_of(float mark) {
  uint32_t bits;
  std::memcpy(&bits, &mark, sizeof bits);
  return bits < MARK ? -1 : static_cast<int32_t>(bits - MARK);
}

}  // namespace splatax
