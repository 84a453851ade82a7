#include "work.h"

#include <mutex>

namespace splatax::cuda {
namespace {

constexpr unsigned PORTABLE = 1;        // CU_MEMHOSTALLOC_PORTABLE: pinned for every GPU
constexpr unsigned WITHOUT_TIMING = 2;  // CU_EVENT_DISABLE_TIMING

// Pinned words, which are expensive to allocate and are used again. They are never destroyed, because threads of
// XLA may still run when a program ends.
std::mutex mutex;
std::vector<uint32_t*>& spare_words = *new std::vector<uint32_t*>;

uint32_t* take_word() {
  {
    const std::lock_guard<std::mutex> lock(mutex);
    if (!spare_words.empty()) {
      uint32_t* word = spare_words.back();
      spare_words.pop_back();
      return word;
    }
  }
  void* word = nullptr;
  check(driver().cuMemHostAlloc(&word, sizeof(uint32_t), PORTABLE), "cuMemHostAlloc");
  return static_cast<uint32_t*>(word);
}

void give_back(uint32_t* word) {
  const std::lock_guard<std::mutex> lock(mutex);
  spare_words.push_back(word);
}

}  // namespace

Count::Count(const uint32_t* at, Handle stream) : pinned_(take_word()) {
  try {
    check(driver().cuEventCreate(&copied_, WITHOUT_TIMING), "cuEventCreate");
    check(driver().cuMemcpyDtoHAsync_v2(pinned_, reinterpret_cast<Address>(at), sizeof *pinned_, stream),
          "cuMemcpyDtoHAsync");
    check(driver().cuEventRecord(copied_, stream), "cuEventRecord");
  } catch (...) {
    if (copied_) driver().cuEventDestroy_v2(copied_);
    throw;  // the word is lost, because a copy may still be under way
  }
}

Count::~Count() {
  driver().cuEventSynchronize(copied_);  // before another call may use the word
  driver().cuEventDestroy_v2(copied_);
  give_back(pinned_);
}

uint32_t Count::wait() {
  check(driver().cuEventSynchronize(copied_), "cuEventSynchronize");
  return *pinned_;
}

Work::Work(Handle stream, std::function<void*(size_t)> allocate) : stream_(stream), allocate_(std::move(allocate)) {
  Handle context = nullptr;
  check(driver().cuStreamGetCtx(stream_, &context), "cuStreamGetCtx");
  check(driver().cuCtxPushCurrent_v2(context), "cuCtxPushCurrent");
}

Work::~Work() {
  Handle context = nullptr;
  driver().cuCtxPopCurrent_v2(&context);
}

Work::Scope::~Scope() {
  for (Block& block : work_.blocks_) {
    if (block.depth > outer_) block.depth = FREE;
  }
  work_.depth_ = outer_;
}

void* Work::memory(size_t bytes) {
  for (Block& block : blocks_) {
    if (block.depth != FREE || block.bytes != bytes) continue;
    block.depth = depth_;
    return block.at;
  }
  blocks_.push_back({allocate_(bytes), bytes, depth_});
  return blocks_.back().at;
}

std::vector<uint32_t> Work::read(const uint32_t* at, size_t count) {
  std::vector<uint32_t> numbers(count);
  check(driver().cuMemcpyDtoHAsync_v2(numbers.data(), reinterpret_cast<Address>(at), count * sizeof(uint32_t), stream_),
        "cuMemcpyDtoHAsync");
  check(driver().cuStreamSynchronize(stream_), "cuStreamSynchronize");
  return numbers;
}

}  // namespace splatax::cuda
