// The work of one call of XLA on the GPU: launches, scratch memory and counts that the host must know.
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "arguments.cuh"
#include "driver.h"
#include "profile.h"

namespace splatax::cuda {

constexpr int BLOCK_SIZE = 256;  // threads in a block of every kernel

inline int blocks_for(int64_t items, int each = BLOCK_SIZE) { return static_cast<int>((items + each - 1) / each); }

// A number on its way from the GPU. The copy is queued at once, and `wait` returns it.
class Count {
 public:
  Count(const uint32_t* at, Handle stream);
  ~Count();
  Count(const Count&) = delete;
  uint32_t wait();

 private:
  uint32_t* pinned_;
  Handle copied_ = nullptr;  // event
};

class Work {
 public:
  // `allocate` returns device memory that stays valid until the work is done, or throws Failure.
  Work(Handle stream, std::function<void*(size_t)> allocate);
  ~Work();
  Work(const Work&) = delete;

  template <class T>
  T* allocate(size_t count) {
    return static_cast<T*>(memory(std::max<size_t>(count, 1) * sizeof(T)));
  }

  // What is allocated during its life may be allocated again afterwards: work is done in the order of its queue.
  class Scope {
   public:
    explicit Scope(Work& work) : work_(work), outer_(work.depth_) { ++work_.depth_; }
    ~Scope();
    Scope(const Scope&) = delete;

   private:
    Work& work_;
    int outer_;
  };

  // Queues a kernel. The arguments must have exactly the types of its parameters.
  template <class... Arguments>
  void launch(const std::string& name, int blocks, Arguments... arguments) {
    if (blocks <= 0) return;
    void* addresses[] = {&arguments...};
    const Stopwatch stopwatch(name, stream_);
    check(driver().cuLaunchKernel(kernel(name), blocks, 1, 1, BLOCK_SIZE, 1, 1, 0, stream_, addresses, nullptr),
          name.c_str());
  }

  void clear(void* at, size_t bytes) {
    if (bytes) check(driver().cuMemsetD8Async(reinterpret_cast<Address>(at), 0, bytes, stream_), "cuMemsetD8Async");
  }

  void copy(void* to, const void* from, size_t bytes) {
    if (!bytes || to == from) return;
    const auto address = [](const void* at) { return reinterpret_cast<Address>(at); };
    check(driver().cuMemcpyDtoDAsync_v2(address(to), address(from), bytes, stream_), "cuMemcpyDtoDAsync");
  }

  // Copies numbers to the host, after all work that is queued.
  std::vector<uint32_t> read(const uint32_t* at, size_t count);

  Handle stream() const { return stream_; }

 private:
  struct Block {
    void* at;
    size_t bytes;
    int depth;  // of the scope that uses it; FREE if none does
  };
  static constexpr int FREE = -1;

  void* memory(size_t bytes);

  Handle stream_;
  std::function<void*(size_t)> allocate_;
  std::vector<Block> blocks_;
  int depth_ = 0;
};

}  // namespace splatax::cuda
