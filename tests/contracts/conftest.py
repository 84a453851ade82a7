"""The backends that contracts are tested on."""

import pytest

from splatax import backends


@pytest.fixture(
    params=[name for name in backends.BACKENDS if name != "cpu"]
)  # which is the best of its builds
def backend(request):
    """The name of each backend in turn; those that this machine cannot run are skipped."""
    if reason := backends.why_unavailable(request.param):
        pytest.skip(reason)
    return request.param
