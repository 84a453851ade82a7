"""The backends that contracts are tested on."""

import pytest
from enrolled import NAMES, available

import emulated
from splatax.backends.cpu import library


@pytest.fixture(params=NAMES)
def backend(request):
    """Each backend in turn, as a name or kernels; those that this machine cannot run are skipped."""
    return available(request.param)


@pytest.fixture(params=[name for name in NAMES if name != "reference"])
def fast(request):
    """Each backend that is compared with the reference."""
    return available(request.param)


WHAT_A_BUILD_CHANGES = (  # modules of values and gradients that the machine code computes
    "test_rasterizers",
    "test_projections",
    "test_photometric",
    "test_lens_kernels",
    "test_slanted",
    "test_planes",
)
IN_OTHER_MODULES = (
    "test_forward_mode_of_the_rasterizer_equals_finite_differences",
    "test_every_output_equals_the_reference",
)
COMPOSED = (  # by JAX, of derivatives that other tests hold to the reference
    "test_the_jacobian_in_a_pose_is_the_same_in_both_modes",
    "test_forward_mode_composes_with_jit_vmap_scan_and_checkpoint",
    "test_gauss_newton_products_equal_the_reference",
    "test_the_gradient_of_a_jvp_of_a_batch_is_that_of_its_elements",
    "test_the_gradient_of_a_scene_that_cameras_share_is_the_sum_of_theirs",
)


def pytest_collection_modifyitems(config, items):
    """Marks what runs on a build of the native library that this machine would not choose by itself, and
    what repeats, with long compilations, what other cases of a contract have shown. Leaves out what the
    instruction set of a build cannot change: doors, names of outputs, and rules of transformations."""
    best = None if library.why_unavailable(None) else f"cpu-{library.best_instructions()}"
    others = {f"cpu-{instructions}" for instructions in library.INSTRUCTIONS} - {best}
    left_out = set()
    for item in items:
        if not (isinstance(item, pytest.Function) and "[" in item.name):
            continue
        parameters = item.callspec.params
        if any(value in others for value in parameters.values() if isinstance(value, str)):
            item.add_marker(pytest.mark.other_build)
            module = item.module.__name__.rpartition(".")[2]
            if module not in WHAT_A_BUILD_CHANGES and item.originalname not in IN_OTHER_MODULES:
                left_out.add(item)
        if repeats(item.module.__name__, parameters):
            item.add_marker(pytest.mark.slow)
        if backend_of(parameters) == "xla" and parameters.get("channels", 5) not in (5, 17):
            left_out.add(item)  # the portable backend is one program for all widths
        if item.originalname in COMPOSED and backend_of(parameters) in ("reference", emulated.NAME):
            left_out.add(
                item
            )  # the oracle is plain JAX; emulated CUDA has the derivatives of the portable backend
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]


def repeats(module, parameters):
    """Whether `make slow` suffices for a case: the oracle under transformations of JAX; the emulated CUDA
    backend under those that go through the derivatives of the portable backend."""
    transformed = ("test_derivatives", "test_transformations")
    if backend_of(parameters) == emulated.NAME:
        return module.endswith(transformed)
    others = ("test_outputs", "test_parts", "test_doors")
    return backend_of(parameters) == "reference" and module.endswith((*transformed, *others))


def backend_of(parameters):
    """The name of the backend among the parameters of a test, or None."""
    named = (value for value in parameters.values() if isinstance(value, str) and value in NAMES)
    return next(named, None)
