import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def promotion():
    """Optax raises floats to integer powers, which JAX refuses in strict mode."""
    with jax.numpy_dtype_promotion("standard"):
        yield
