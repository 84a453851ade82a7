// Compares the declarations of native/cuda/host/driver.h with NVIDIA's cuda.h. It is compiled, but not run.
#include <cuda.h>

#include <type_traits>

#include "driver.h"

namespace {

using splatax::cuda::Driver;

// Handles are pointers here, and enumerations and devices are integers.
template <class Own, class Theirs>
constexpr bool alike = sizeof(Own) == sizeof(Theirs) && std::is_pointer_v<Own> == std::is_pointer_v<Theirs>;

template <class Own, class Theirs>
constexpr bool same_call = false;
template <class R, class... A, class S, class... B>
constexpr bool same_call<R (*)(A...), S(B...)> = [] {
  if constexpr (sizeof...(A) != sizeof...(B)) {
    return false;
  } else {
    return sizeof(R) == sizeof(S) && (alike<A, B> && ...);
  }
}();

// Where cuda.h defines a name as a macro for its newest version, the name in driver.h, included after it, follows.
#define HOLD(name) static_assert(same_call<decltype(Driver::name), decltype(name)>, #name)
HOLD(cuInit);
HOLD(cuGetErrorName);
HOLD(cuLibraryLoadData);
HOLD(cuLibraryGetKernel);
HOLD(cuLaunchKernel);
HOLD(cuMemsetD8Async);
HOLD(cuMemcpyDtoDAsync_v2);
HOLD(cuMemcpyDtoHAsync_v2);
HOLD(cuMemHostAlloc);
HOLD(cuStreamSynchronize);
HOLD(cuStreamGetCtx);
HOLD(cuCtxPushCurrent_v2);
HOLD(cuCtxPopCurrent_v2);
HOLD(cuCtxGetDevice);
HOLD(cuDeviceGetAttribute);
HOLD(cuEventCreate);
HOLD(cuEventRecord);
HOLD(cuEventSynchronize);
HOLD(cuEventElapsedTime);
HOLD(cuEventDestroy_v2);

// Numbers that the host side writes out.
static_assert(CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR == 75);
static_assert(CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR == 76);
static_assert(CU_MEMHOSTALLOC_PORTABLE == 1 && CU_EVENT_DISABLE_TIMING == 2);

}  // namespace
