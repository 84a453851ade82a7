// Memory that only grows, is not initialized, and is kept between calls, because fresh pages are slow.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>

namespace splatax {

template <class T>
class Buffer {
 public:
  T* at_least(size_t size) {
    if (size > size_) {
      const size_t roomy = size + size / 4;
      size_ = 0;  // if there is no memory, `new` throws and nothing is held
      memory_.reset();
      memory_.reset(new T[roomy]);
      size_ = roomy;
    }
    return memory_.get();
  }
  // Returns memory for records of another type, which start at a cache line.
  template <class Record>
  Record* aligned(size_t count) {
    const auto address = reinterpret_cast<uintptr_t>(at_least((count * sizeof(Record) + 63) / sizeof(T) + 64));
    return reinterpret_cast<Record*>((address + 63) / 64 * 64);
  }
  T* get() const { return memory_.get(); }
  T& operator[](size_t i) const { return memory_[i]; }

 private:
  size_t size_ = 0;
  std::unique_ptr<T[]> memory_;
};

}  // namespace splatax
