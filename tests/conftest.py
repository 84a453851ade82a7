"""Every test runs with shapes checked, and with JAX refusing silent promotions."""

import atexit
import gc
import itertools
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

# XLA's compiler takes most of the time. It optimizes little here, which changes roundings but no rule that is
# tested; with SPLATAX_OPTIMIZED=1 tests run what users run. Workers, and the commands that tests start, share
# what has been compiled. JAX reads these variables when it is imported; later processes inherit them.
if "SPLATAX_OPTIMIZED" not in os.environ:
    little = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    if version("jaxlib").startswith("0.10."):  # XLA ends a process that names a flag it does not know
        little += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {little}".strip()
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="splatax-programs-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

import jax
import jaxtyping
import numpy as np
import pytest

gc.set_threshold(200_000, 50, 100)  # tracing allocates much that lives on
_register = jax.tree_util.register_pytree_with_keys


def _register_unchecked(record, *functions):
    """JAX rebuilds records around placeholders and batched leaves, which have other shapes than the
    fields declare: check functions, not the `__init__` of pytrees."""
    record.__no_type_check__ = True
    _register(record, *functions)


jax.tree_util.register_pytree_with_keys = _register_unchecked
jaxtyping.install_import_hook("splatax", "beartype.beartype")
if "SPLATAX_NATIVE" in os.environ:  # another build of the native library: `make sanitize`
    from splatax.backends.cpu import library

    library.FOLDER = Path(os.environ["SPLATAX_NATIVE"])
_compiled = jax.lax.stage_p.impl if "stage_p" in vars(jax.lax) else None
if _compiled:  # by jax 0.10.2, a program for each shape of NumPy array that `jnp.asarray` gets
    jax.lax.stage_p.def_impl(lambda x: jax.device_put(x) if np.ndim(x) else _compiled(x))
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


MOST_MAPPINGS = 45_000  # of memory, per process; Linux allows 65,530
MAPPINGS = Path("/proc/self/maps")
_tests = itertools.count(1)


@pytest.fixture(autouse=True)
def few_programs():
    """Frees compiled programs before there are too many: each has several mappings of memory, and XLA's
    compiler aborts the process when Linux gives it no more."""
    yield
    if next(_tests) % 20 == 0 and MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()


@pytest.fixture
def as_users_have_it():
    """Switches off the checks of types and shapes that the tests add to every function."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def x64():
    """Double precision inside the test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real captures and splat files; tests that need it skip without."""
    path = Path(os.environ.get("SPLATAX_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real data: set SPLATAX_DATA (looked in {path})")
    return path
