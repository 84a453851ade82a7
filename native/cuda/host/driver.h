// NVIDIA's driver, opened at run time: building needs neither CUDA's headers nor its libraries, and the library
// loads where there is no GPU.
#pragma once

#include <cstddef>
#include <stdexcept>
#include <string>

namespace splatax::cuda {

using Handle = void*;                // context, stream, event, library or kernel of the driver
using Address = unsigned long long;  // in device memory

// Functions of the driver, as NVIDIA's cuda.h declares them. tests/backends/test_cuda.py compares the types
// with that header where it is installed.
struct Driver {
  int (*cuInit)(unsigned);
  int (*cuGetErrorName)(int, const char**);
  int (*cuLibraryLoadData)(Handle*, const void*, void*, void**, unsigned, void*, void**, unsigned);
  int (*cuLibraryGetKernel)(Handle*, Handle, const char*);
  int (*cuLaunchKernel)(Handle, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, Handle, void**,
                        void**);
  int (*cuMemsetD8Async)(Address, unsigned char, size_t, Handle);
  int (*cuMemcpyDtoDAsync_v2)(Address, Address, size_t, Handle);
  int (*cuMemcpyDtoHAsync_v2)(void*, Address, size_t, Handle);
  int (*cuMemHostAlloc)(void**, size_t, unsigned);
  int (*cuStreamSynchronize)(Handle);
  int (*cuStreamGetCtx)(Handle, Handle*);
  int (*cuCtxPushCurrent_v2)(Handle);
  int (*cuCtxPopCurrent_v2)(Handle*);
  int (*cuCtxGetDevice)(int*);
  int (*cuDeviceGetAttribute)(int*, int, int);
  int (*cuEventCreate)(Handle*, unsigned);
  int (*cuEventRecord)(Handle, Handle);
  int (*cuEventSynchronize)(Handle);
  int (*cuEventElapsedTime)(float*, Handle, Handle);
  int (*cuEventDestroy_v2)(Handle);
};

// A call of the driver that failed, or a limit of the kernels.
class Failure : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// Opens the driver: a path, or a name such as libcuda.so.1. Throws Failure if it cannot, or if a function that
// is needed is missing.
void open_driver(const char* path);

// Returns the driver that was opened. Throws Failure if there is none.
const Driver& driver();

// Throws Failure if a function of the driver returned an error code.
void check(int code, const char* function);

// Gives the kernels for GPUs of one compute capability (90 for 9.0) to the driver: a cubin, or PTX.
void load_kernels(int capability, const void* binary);

// Returns a kernel for the current GPU. Throws Failure if it was not loaded.
Handle kernel(const std::string& name);

}  // namespace splatax::cuda
