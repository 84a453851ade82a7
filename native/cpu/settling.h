// Arrays of the scene and its moments, which live for many steps, in pages of 2 MB: a step visits rows all over them, and
// with pages of 4 KB it waits for the addresses of pages.
#pragma once

#include <algorithm>
#include <mutex>
#include <utility>
#include <vector>

#include "large_pages.h"

namespace splatax {

// Moves arrays to large pages, where the system can. An array that was moved before is left alone.
class Settling {
 public:
  void settle([[maybe_unused]] void* data, [[maybe_unused]] size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    if (bytes < LEAST) return;
    const std::lock_guard<std::mutex> lock(mutex_);
    const Place place(data, bytes);
    if (std::find(known_.begin(), known_.end(), place) != known_.end()) return;
    if (known_.size() == MOST) known_.erase(known_.begin());
    known_.push_back(place);
    constexpr uintptr_t PAGE = uintptr_t{1} << 21;
    const uintptr_t begin = (reinterpret_cast<uintptr_t>(data) + PAGE - 1) / PAGE * PAGE;
    const uintptr_t end = (reinterpret_cast<uintptr_t>(data) + bytes) / PAGE * PAGE;
    madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
    madvise(reinterpret_cast<void*>(begin), end - begin, COLLAPSE);
#endif
  }

 private:
  static constexpr int COLLAPSE = 25;               // MADV_COLLAPSE of Linux 6.1, which older headers lack
  static constexpr size_t LEAST = size_t{1} << 23;  // bytes: smaller arrays gain little
  static constexpr size_t MOST = 64;                // arrays that are remembered
  using Place = std::pair<void*, size_t>;

  std::mutex mutex_;
  std::vector<Place> known_;
};

inline Settling settling;

}  // namespace splatax
