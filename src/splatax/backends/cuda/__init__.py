"""The CUDA backend: kernels in CUDA C++ for NVIDIA GPUs (`native/cuda/` of the repository).

NVRTC compiles the kernels at run time, so neither building nor installing needs the CUDA toolkit. Results
do not depend on the order in which threads run. Single precision only. No GPU has run it yet: it is tested on
the CPU, where the same handlers and kernels run under an emulation.
"""

from collections.abc import Callable
from functools import partial

from splatax import surfaces
from splatax.backends import fused_loss, projection_kernels
from splatax.backends.cuda import nvidia
from splatax.backends.cuda.composite import MAX_PAIRS, composite
from splatax.backends.cuda.library import Library
from splatax.backends.cuda.moving import move
from splatax.backends.cuda.photometric import with_gradient
from splatax.backends.cuda.projection import GpuProjection
from splatax.backends.portable.select import select
from splatax.backends.protocol import Kernels
from splatax.cameras.lenses import Pinhole


def kernels(
    library: Library = nvidia.LIBRARY,
    name: str = "cuda",
    max_pairs: int = MAX_PAIRS,
    why_unavailable: Callable[[], str | None] = nvidia.why_unavailable,
) -> Kernels:
    """Returns the kernels that a library runs. Settings other than the defaults are for tests.

    Args:
        library: the handlers and their device.
        name: identifies the backend.
        max_pairs: the number of (splat, tile) pairs that are listed at a time.
        why_unavailable: returns why they cannot run here, or None.
    """
    return Kernels(
        name=name,
        project=partial(projection_kernels.project, kernels={Pinhole: GpuProjection(library)}),
        composite=partial(composite, library=library, max_pairs=max_pairs),
        select=select,
        photometric=partial(fused_loss.photometric, kernel=partial(with_gradient, library=library)),
        move=partial(move, library=library),
        planes=surfaces.planes,
        why_unavailable=why_unavailable,
        dtypes=("float32",),
    )


KERNELS = kernels()
