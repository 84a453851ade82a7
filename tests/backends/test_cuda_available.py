"""Selection of the CUDA backend, reasons why it is unavailable, and programs for GPUs of other machines."""

import re
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.backends import cuda
from splatax.backends.cuda import library, nvidia, nvrtc
from splatax.backends.protocol import runs_everywhere
from splatax.losses import Photometric
from splatax.moving import Moments, Rule, Step
from splatax.rendering import render
from splatax.training.optimizer import LearningRates

WHY_REFUSED = nvidia._why_refused


@pytest.fixture
def gpu(monkeypatch, tmp_path):
    """Makes JAX say that it runs on a GPU of this platform, which the driver and XLA accept."""

    def of(platform):
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(nvidia, "platform_version", lambda: platform)
        monkeypatch.setattr(nvidia, "_why_refused", lambda: None)
        monkeypatch.setattr(nvidia, "_compiler", lambda: SimpleNamespace(version=(12, 9)))
        path = tmp_path / "libsplatax_cuda.so"
        path.touch()
        monkeypatch.setattr(nvidia, "LIBRARY", replace(nvidia.LIBRARY, path=path))

    return of


def test_auto_takes_it_on_nvidia_gpus(gpu):
    gpu("PJRT C API\ncuda 12090")
    assert backends.resolve().name == "cuda"


def test_auto_takes_the_portable_backend_on_other_gpus(gpu):
    gpu("PJRT C API\nrocm 60300")
    assert backends.resolve().name == "xla"
    assert "JAX runs on PJRT C API\nrocm 60300 here" in cuda.KERNELS.why_unavailable()


def test_auto_takes_the_portable_backend_in_double_precision(gpu):
    gpu("cuda 12090")
    assert backends.resolve(dtype=jnp.float64).name == "xla"


def test_elsewhere_it_says_where_it_runs():
    if jax.default_backend() == "gpu":
        pytest.skip("it is at home here")
    with pytest.raises(ValueError, match="'cuda' is not available: it runs on NVIDIA GPUs, and JAX runs on"):
        backends.resolve("cuda")


@pytest.mark.parametrize(
    ("platform", "wheel"), [("cuda 12090", "nvidia-cuda-nvrtc-cu12"), ("cuda 13000", "nvidia-cuda-nvrtc")]
)
def test_without_the_compiler_it_says_which_wheel_to_install(gpu, monkeypatch, platform, wheel):
    gpu(platform)
    monkeypatch.setattr(nvidia, "_compiler", lambda: None)
    assert re.search(f"pip install {wheel}$", cuda.KERNELS.why_unavailable())


def test_without_the_library_it_says_how_to_get_it(gpu):
    gpu("cuda 12090")
    nvidia.LIBRARY.path.unlink()
    assert "has no library for CUDA" in cuda.KERNELS.why_unavailable()


def test_what_the_driver_refuses_is_the_reason(gpu, monkeypatch):
    gpu("cuda 12090")
    for error in (OSError("no driver"), nvrtc.CompileError("NVRTC reports an error")):

        def refused(library, error=error):
            raise error

        monkeypatch.setattr(nvidia, "register", refused)
        monkeypatch.setattr(nvidia, "_why_refused", WHY_REFUSED.__wrapped__)
        assert cuda.KERNELS.why_unavailable() == str(error)


# --- programs for GPUs that are elsewhere ---

ELSEWHERE = replace(cuda.KERNELS, why_unavailable=runs_everywhere)
needs_library = pytest.mark.skipif(
    not nvidia.LIBRARY.path.exists(), reason="the library for CUDA was not built"
)


def train(gaussians, camera, photo):
    def objective(gaussians):
        image = render(gaussians, camera, backend=ELSEWHERE).rgb
        return Photometric()(image, photo, kernel=ELSEWHERE.photometric)

    gradients = jax.grad(objective)(gaussians)
    one, true = jnp.float32(1), jnp.asarray(True)
    rates = LearningRates().at(one, one[None], 4)
    keys = jnp.zeros((1, 2), jnp.uint32)
    step = Step(rates, jnp.ones(4, bool), true, jnp.int32(1), jnp.int32(30), one, keys)
    moments = Moments(gradients, gradients)
    return ELSEWHERE.move(gaussians, gradients, moments, step, Rule(0.9, 0.999, 1e-15), len(gaussians))


@needs_library
def test_a_step_is_lowered_for_cuda_on_a_machine_without_it():
    arguments = (random_gaussians(n=30, degree=1), camera_at(), jnp.zeros((24, 32, 3)))
    lowered = jax.jit(train).trace(*arguments).lower(lowering_platforms=("cuda",))
    assert set(re.findall(r"splatax_\w+", lowered.as_text())) >= set(library.SYMBOLS)


@needs_library
def test_a_step_is_exported_for_cuda_on_a_machine_without_it():
    arguments = (random_gaussians(n=30, degree=1), camera_at(), jnp.zeros((24, 32, 3)))
    checks = [jax.export.DisabledSafetyCheck.custom_call(symbol) for symbol in library.SYMBOLS]
    exported = jax.export.export(jax.jit(train), platforms=["cuda"], disabled_checks=checks)(*arguments)
    assert exported.platforms == ("cuda",)
