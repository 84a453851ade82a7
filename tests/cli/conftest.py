import jax
import pytest

from captures import write_capture
from splatax import cli


@pytest.fixture(scope="package", autouse=True)
def promotion():
    """Optax raises floats to integer powers, which JAX refuses in strict mode."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """Compiled programs of tests stay out of the user's cache."""
    monkeypatch.setattr(cli, "keep_compiled_programs", lambda: None)


@pytest.fixture(scope="package")
def capture(tmp_path_factory):
    """Nine photos of noise."""
    return write_capture(tmp_path_factory.mktemp("captures") / "noise")


@pytest.fixture(scope="package")
def trained(capture, tmp_path_factory):
    """The folder of a short run, with an evaluation in the middle."""
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "keep_compiled_programs", lambda: None)
        cli.main(["train", str(capture), "--out", str(out), "--steps", "6", "--eval-every", "3"])
    return out
