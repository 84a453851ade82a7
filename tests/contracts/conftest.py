"""The backends that contracts are tested on."""

import pytest
from enrolled import NAMES, available

from splatax.backends.cpu import library
from splatax.footprints import Unscented


@pytest.fixture(params=NAMES)
def backend(request):
    """Each backend in turn, as a name or kernels; those that this machine cannot run are skipped."""
    return available(request.param)


def pytest_collection_modifyitems(items):
    """Marks what runs on a build of the native library that this machine would not choose by itself, and
    what repeats, with long compilations, what other cases of a contract have shown."""
    best = None if library.why_unavailable(None) else f"cpu-{library.best_instructions()}"
    others = {f"cpu-{instructions}" for instructions in library.INSTRUCTIONS} - {best}
    for item in items:
        if not (isinstance(item, pytest.Function) and "[" in item.name):
            continue
        parameters = item.callspec.params
        if any(value in others for value in parameters.values() if isinstance(value, str)):
            item.add_marker(pytest.mark.other_build)
        if repeats(item.originalname, item.module.__name__, parameters):
            item.add_marker(pytest.mark.slow)


def repeats(name, module, parameters):
    """Whether `make slow` suffices for a case: the oracle under transformations of JAX; the portable backend
    with more widths, all of which one program serves; the unscented transform through each lens."""
    named = (value for value in parameters.values() if isinstance(value, str) and value in NAMES)
    backend = next(named, None)
    if backend == "reference":
        return module.endswith(("test_derivatives", "test_transformations", "test_outputs"))
    if backend == "xla" and "channels" in parameters:
        return parameters["channels"] not in (5, 17)
    if name == "test_every_parameter_of_the_camera_matches_finite_differences":
        return parameters["method"] == Unscented() and parameters["lens"] != "opencv"
    return False
