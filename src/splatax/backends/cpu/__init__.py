"""The CPU backend: C++ with SIMD for the instruction set of the machine (`native/cpu/` of the repository).

Results do not depend on the number of threads. Single precision only.
"""

from functools import partial

from splatax.backends import fused_loss, projection_kernels
from splatax.backends.cpu import library
from splatax.backends.cpu.composite import MAX_PAIRS, composite, select
from splatax.backends.cpu.library import ALL_THREADS, Build
from splatax.backends.cpu.moving import NativePullAndMove, move
from splatax.backends.cpu.photometric import with_gradient
from splatax.backends.cpu.planes import planes
from splatax.backends.cpu.projection import projections
from splatax.backends.cpu.survey import NativeSurvey
from splatax.backends.cpu.views import NativeDrawing
from splatax.backends.protocol import Kernels


def kernels(
    instructions: str | None = None, threads: int = ALL_THREADS, max_pairs: int = MAX_PAIRS
) -> Kernels:
    """Returns the native kernels for an instruction set. Settings other than the defaults are for tests.

    Args:
        instructions: one of `library.INSTRUCTIONS`; None for the best that this machine has.
        threads: how many threads of XLA's pool to use; 0 for all.
        max_pairs: the number of (splat, tile) pairs that are listed at a time.
    """
    build = Build(instructions, threads)
    projection = partial(projection_kernels.project, kernels=projections(build))
    rasterizer = partial(composite, build=build, max_pairs=max_pairs)
    selection = partial(select, build=build, max_pairs=max_pairs)
    step = partial(move, build=build)
    return Kernels(
        name="cpu" if instructions is None else f"cpu-{instructions}",
        project=projection,
        composite=rasterizer,
        select=selection,
        photometric=partial(fused_loss.photometric, kernel=partial(with_gradient, build=build)),
        move=step,
        planes=partial(planes, build=build),
        why_unavailable=partial(library.why_unavailable, instructions),
        dtypes=("float32",),
        draw=NativeDrawing(build, max_pairs, projection, rasterizer),
        survey=NativeSurvey(build, max_pairs, rasterizer, selection),
        pull_and_move=NativePullAndMove(build, projection, step),
    )


BEST = kernels()
AVX512, AVX2, BASELINE = (kernels(instructions) for instructions in library.INSTRUCTIONS)
