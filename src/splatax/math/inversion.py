"""Inverses of smooth functions, by tables and by Newton's method, with exact derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STEPS = 10  # of Newton's method, which doubles the digits in each


class Rise(NamedTuple):
    """Table of a function, from zero up to where it stops growing.

    Attributes:
        inputs: growing up to the limit, and constant behind it.
        outputs: values of the function there.
        limit: input up to which the function grows; infinite if it grows over the whole table.
    """

    inputs: Float[Array, " m"]
    outputs: Float[Array, " m"]
    limit: Float[Array, ""]

    def inverse(self, output: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the input of an output, by linear interpolation; the last input for larger outputs."""
        return jnp.interp(output, self.outputs, self.inputs)


def rise_of(function: Callable[[Array], Array], inputs: Float[Array, " m"]) -> Rise:
    """Tabulates an elementwise function with value 0 at 0. The table has no gradient.

    Args:
        function: maps an array elementwise.
        inputs: growing, from zero.
    """
    outputs, slopes = jax.jvp(function, (inputs,), (jnp.ones_like(inputs),))
    # Behind a pole slopes are positive too, but the values begin again far below.
    higher = jnp.append(True, outputs[1:] > outputs[:-1])
    grows = jnp.cumprod((slopes > 0) & higher & jnp.isfinite(outputs)) > 0
    last = jnp.maximum(jnp.sum(grows) - 1, 0)
    limit = jnp.where(jnp.all(grows), jnp.inf, inputs[last])
    kept = jnp.where(grows, inputs, inputs[last]), jnp.where(grows, outputs, outputs[last]), limit
    return Rise(*jax.lax.stop_gradient(kept))


def solved(
    function: Callable[[Any, Array], Array],
    parameters: Any,
    target: Float[Array, "2"],
    start: Float[Array, "2"],
) -> Float[Array, "2"]:
    """Returns x with function(parameters, x) = target, by Newton's method from `start`.

    Derivatives in parameters and target are exact up to the third: the search itself has none, and each of
    two more steps from its result doubles the order to which the result depends on them.
    """

    def step(x, parameters, target):
        jacobian = jax.jacfwd(lambda x: function(parameters, x))(x)
        return x + _solve(jacobian, target - function(parameters, x))

    fixed = jax.lax.stop_gradient((parameters, target))
    x, _ = jax.lax.scan(lambda x, _: (step(x, *fixed), None), jax.lax.stop_gradient(start), length=STEPS)
    for _ in range(2):
        x = step(x, parameters, target)
    return x


def _solve(matrix: Float[Array, "2 2"], vector: Float[Array, "2"]) -> Float[Array, "2"]:
    """Returns matrix^-1 vector; the vector itself if the matrix has no inverse."""
    (a, b), (c, d) = matrix
    determinant = a * d - b * c
    safe = jnp.where(determinant == 0, 1, determinant)
    solution = jnp.array([d * vector[0] - b * vector[1], a * vector[1] - c * vector[0]]) / safe
    return jnp.where(determinant == 0, vector, solution)
