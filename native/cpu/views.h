// Loop over the views of a batch.
#pragma once

#include <atomic>
#include <memory>
#include <new>

#include "rasterize.h"

namespace splatax {

// Calls body(view, workers, scratch) for each view. Views are drawn side by side, each by one thread, as long as there
// are enough for all threads; the last ones are drawn one after the other, each by all threads. Memory has the
// memories of its `threads`.
template <class Memory, class Body>
void each_view(int views, Workers& workers, Memory& scratch, const Body& body) {
  const int threads = workers.count(), together = threads > 1 ? views / threads * threads : 0;
  if (together > 0) {
    while (static_cast<int>(scratch.threads.size()) < threads) scratch.threads.push_back(std::make_unique<Memory>());
    std::atomic<int> next{0};
    std::atomic<bool> failed{false};
    workers.each(threads, [&](int thread) {
      Workers alone = workers.alone();
      try {
        for (int view; (view = next.fetch_add(1)) < together;) body(view, alone, *scratch.threads[thread]);
      } catch (const std::bad_alloc&) {  // it must not leave the thread; see `guarded`
        failed = true;
      }
    });
    if (failed) throw std::bad_alloc();
  }
  for (int view = together; view < views; ++view) body(view, workers, scratch);
}

}  // namespace splatax
