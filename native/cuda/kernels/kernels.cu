// All kernels, as one program.
#include "binning.cuh"
#include "blending.cuh"
#include "gradient.cuh"
#include "records.cuh"
