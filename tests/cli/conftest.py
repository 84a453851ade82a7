import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
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


@pytest.fixture(scope="package")
def wall(tmp_path_factory):
    """The splat file of a wall at z = 5, which fills every view, and a capture with points on both sides."""
    folder = tmp_path_factory.mktemp("wall")
    capture = write_capture(folder / "capture", count=5)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-6, 6, 41), np.linspace(-6, 6, 41)))
    n = len(x)
    scene = sx.Gaussians(
        means=jnp.asarray(np.stack([x, y, np.full(n, 5.0)], axis=1), jnp.float32),
        log_scales=jnp.broadcast_to(jnp.log(jnp.array([0.25, 0.25, 1e-3])), (n, 3)),
        quats=jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (n, 4)),
        opacity_logits=jnp.full(n, 4.0),
        sh=jnp.zeros((n, 1, 3)),
    )
    sx.save(folder / "wall.ply", scene)
    return folder / "wall.ply", capture
