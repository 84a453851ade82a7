// Memory of large results in pages of 2 MB, where the system has them. XLA takes the memory of each step anew, and with
// pages of 4 KB the system is busy with them for longer than the kernels are with the numbers.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace splatax {

// Asks for large pages where a result is not written yet. It is a hint: nothing depends on the answer.
inline void in_large_pages([[maybe_unused]] void* data, [[maybe_unused]] size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr uintptr_t PAGE = uintptr_t{1} << 21;
  const uintptr_t begin = (reinterpret_cast<uintptr_t>(data) + PAGE - 1) / PAGE * PAGE;
  const uintptr_t end = (reinterpret_cast<uintptr_t>(data) + bytes) / PAGE * PAGE;
  if (begin < end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

constexpr size_t MOST_BETWEEN = 4;  // times the results

// XLA takes the memory of a program's intermediate results as one piece. What lies between some of them is one too, unless
// it is much longer than they are together.
template <class... Results>
void all_in_large_pages(Results&... results) {
  const uintptr_t begin = std::min({reinterpret_cast<uintptr_t>(results->untyped_data())...});
  const uintptr_t end = std::max({reinterpret_cast<uintptr_t>(results->untyped_data()) + results->size_bytes()...});
  const size_t together = (size_t{0} + ... + results->size_bytes());
  if (end - begin <= MOST_BETWEEN * together) return in_large_pages(reinterpret_cast<void*>(begin), end - begin);
  (in_large_pages(results->untyped_data(), results->size_bytes()), ...);
}

}  // namespace splatax
