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
    what is left to `make slow`. Leaves out what the instruction set of a build cannot change: doors, names of
    outputs, and rules of transformations."""
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
        if left_to_slow(item):
            item.add_marker(pytest.mark.slow)
        if backend_of(parameters) == "xla" and parameters.get("channels", 5) not in (5, 17):
            left_out.add(item)  # the portable backend is one program for all widths
        if item.originalname in COMPOSED and backend_of(parameters) in ("reference", emulated.NAME):
            left_out.add(
                item
            )  # the oracle is plain JAX; emulated CUDA has the derivatives of the portable backend
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]


LONG_SUITES = (  # where XLA compiles for seconds in each case
    "test_derivatives",
    "test_transformations",
    "test_outputs",
    "test_parts",
    "test_doors",
    "test_slanted",
)
LONG_TESTS = (  # the same, in other suites
    "test_pull_of_culled_rows_is_nothing",
    "test_pull_equals_the_reference_and_leaves_the_other_gradients",
    "test_pull_of_thousands_of_splats_in_one_tile",
    "test_any_number_of_channels",
    "test_thousands_of_splats_in_one_tile",
    "test_one_splat_over_the_whole_image_among_small_ones",
    "test_double_precision_equals_the_reference_to_its_rounding",
    "test_pull_in_double_precision_equals_the_reference_to_its_rounding",
    "test_a_number_that_is_not_finite_culls_its_gaussian_and_changes_no_gradient",
    "test_a_picture_of_a_scene_with_broken_gaussians_has_finite_gradients",
    "test_infinite_numbers_that_mean_something_are_drawn",
)


def left_to_slow(item):
    """Whether `make slow` suffices for a case: the oracle, the portable backend and the emulated CUDA
    backend, where XLA compiles for seconds. `make test` holds them to images, gradients and projections, and
    the native kernels of this machine to everything."""
    if backend_of(item.callspec.params) not in ("reference", "xla", emulated.NAME):
        return False
    return item.originalname in LONG_TESTS or item.module.__name__.endswith(LONG_SUITES)


def backend_of(parameters):
    """The name of the backend among the parameters of a test, or None."""
    named = (value for value in parameters.values() if isinstance(value, str) and value in NAMES)
    return next(named, None)
