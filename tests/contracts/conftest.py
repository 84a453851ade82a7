"""The backends that contracts are tested on."""

import pytest
from enrolled import NAMES, available


@pytest.fixture(params=NAMES)
def backend(request):
    """Each backend in turn, as a name or kernels; those that this machine cannot run are skipped."""
    return available(request.param)
