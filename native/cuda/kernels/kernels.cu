// All kernels, as one program.
#include "binning.cuh"
#include "blending.cuh"
#include "gradient.cuh"
#include "records.cuh"
#include "moving.cuh"
#include "photometric.cuh"
#include "projection.cuh"
#include "projection_gradient.cuh"
