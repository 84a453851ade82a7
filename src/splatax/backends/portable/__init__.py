"""Portable backend: plain JAX for CPU, GPU and TPU."""

from splatax import losses, moving, projection, surfaces
from splatax.backends.portable.composite import composite
from splatax.backends.portable.select import select
from splatax.backends.protocol import Kernels

KERNELS = Kernels(
    "xla", projection.project, composite, select, losses.photometric, moving.move, surfaces.planes
)
