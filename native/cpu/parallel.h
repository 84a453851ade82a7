// Parallel loops on XLA's own threads. Kernels are compiled without XLA's headers, which take longer than most kernels.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <thread>
#include <utility>

namespace splatax {

class Workers {
 public:
  // Uses all threads of an xla::ffi::ThreadPool, or `limit` of them if that is not zero.
  template <class ThreadPool>
  Workers(ThreadPool pool, int64_t limit)
      : schedule_([pool](std::function<void()> task) mutable { pool.Schedule(std::move(task)); }) {
    const int64_t threads = std::max<int64_t>(pool.num_threads(), 1);
    count_ = static_cast<int>(limit > 0 ? std::min(limit, threads) : threads);
  }

  int count() const { return count_; }
  // The calling thread alone.
  Workers alone() const {
    Workers result = *this;
    result.count_ = 1;
    return result;
  }

  // Calls task(i) once for each i in [0, n), in any order, and waits for all. The calling thread works
  // too, and does all the work if the pool is busy, so this cannot deadlock.
  void each(int n, const std::function<void(int)>& task) {
    if (n <= 1 || count_ == 1) {
      for (int i = 0; i < n; ++i) task(i);
      return;
    }
    auto job = std::make_shared<Job>();
    job->size = n;
    job->task = &task;
    for (int helper = 1; helper < std::min(n, count_); ++helper) {
      schedule_([job] { job->work(); });
    }
    job->work();
    job->wait();
  }

  // Splits [0, n) into even ranges, and calls task(range, begin, end) for each.
  template <class Task>
  void ranges(int n, const Task& task) {
    each(count_, [&](int range) {
      const auto bound = [&](int r) { return static_cast<int>(int64_t{n} * r / count_); };
      task(range, bound(range), bound(range + 1));
    });
  }

 private:
  static constexpr int SPINS = 4000;  // about 0.1 ms

  struct Job {
    std::atomic<int> next{0}, done{0};
    int size = 0;
    const std::function<void(int)>* task = nullptr;  // dangling once done == size

    void work() {
      for (int i; (i = next.fetch_add(1)) < size;) {
        (*task)(i);
        done.fetch_add(1, std::memory_order_release);
      }
    }

    // The remaining work takes microseconds. Yielding at once on a busy machine would wait milliseconds.
    void wait() const {
      for (int tries = 0; done.load(std::memory_order_acquire) < size; ++tries) {
        if (tries < SPINS) {
          pause();
        } else {
          std::this_thread::yield();
        }
      }
    }
    static void pause() {
#if defined(__x86_64__)
      __builtin_ia32_pause();
#elif defined(__aarch64__)
      asm volatile("yield");
#endif
    }
  };

  std::function<void(std::function<void()>)> schedule_;
  int count_;
};

}  // namespace splatax
