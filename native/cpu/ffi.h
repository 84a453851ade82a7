// What the CPU handlers share beyond the checks that all handlers do.
#pragma once

#include "../common/ffi.h"

namespace splatax {

using Ticket = ffi::Buffer<ffi::S32>;
using Counts = ffi::ResultBuffer<ffi::S32>;

// Beginning of every binding.
inline auto call() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>(); }

}  // namespace splatax
