"""The backends that contracts are tested on."""

import pytest
from enrolled import NAMES, available

from splatax.backends.cpu import library


@pytest.fixture(params=NAMES)
def backend(request):
    """Each backend in turn, as a name or kernels; those that this machine cannot run are skipped."""
    return available(request.param)


def pytest_collection_modifyitems(items):
    """Marks what runs on a build of the native library that this machine would not choose by itself."""
    best = None if library.why_unavailable(None) else f"cpu-{library.best_instructions()}"
    others = {f"cpu-{instructions}" for instructions in library.INSTRUCTIONS} - {best}
    for item in items:
        parameters = (
            item.callspec.params.values() if isinstance(item, pytest.Function) and "[" in item.name else ()
        )
        if any(value in others for value in parameters if isinstance(value, str)):
            item.add_marker(pytest.mark.other_build)
