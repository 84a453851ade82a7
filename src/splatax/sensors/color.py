"""Colour cameras: exposure, gain, shot noise, read noise, and motion blur."""

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.math import rigid
from splatax.math.srgb import OFFSET, POWER, SLOPE, TOE
from splatax.outputs import Rendering
from splatax.pytrees import pytree
from splatax.sensors.protocol import Key, Plain


@pytree
@dataclass(frozen=True)
class ColorNoise:
    """Noise of an image sensor, in linear light (EMVA 1288's linear model, without dark current).

    A pixel collects e = full_well * exposure * light electrons. Shot noise has the variance e and read noise
    the variance read^2, both in electrons, so a gain amplifies signal and noise alike. Shot noise is drawn
    from the normal distribution, which is close to Poisson's above some ten electrons.

    Attributes:
        exposure: exposure time and aperture relative to that of the photos.
        gain: amplification after the exposure; gain 4 at exposure 1/4 keeps the brightness.
        full_well: electrons of a white pixel at exposure 1.
        read: standard deviation of read noise, electrons.
    """

    exposure: float | Float[Array, ""] = 1.0
    gain: float | Float[Array, ""] = 1.0
    full_well: float | Float[Array, ""] = 10_000.0
    read: float | Float[Array, ""] = 3.0

    def apply(self, light: Float[Array, "h w 3"], key: Key | None) -> Float[Array, "h w 3"]:
        """Returns measured linear light, clipped to [0, 1]; without a key, there is no noise."""
        electrons = self.full_well * self.exposure * jnp.maximum(light, 0)
        if key is not None:
            deviation = jnp.sqrt(electrons + self.read**2)
            electrons = electrons + deviation * jax.random.normal(key, light.shape, light.dtype)
        return jnp.clip(self.gain * electrons / self.full_well, 0, 1)


@pytree
@dataclass(frozen=True)
class MotionBlur:
    """Blur of a camera that moves evenly while its shutter is open.

    Attributes:
        twist: motion during the exposure in camera axes, rotation (radians) before translation (world
            units); see `math.rigid.exponential`.
        samples: views that are averaged (static).
    """

    twist: Float[Array, "6"]
    samples: int = field(default=8, metadata={"static": True})

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """Returns the camera at evenly spaced times of the exposure, its own pose in the middle."""
        times = [(i + 0.5) / self.samples - 0.5 for i in range(self.samples)]
        moved = (rigid.exponential(self.twist * time) @ camera.cam_from_world for time in times)
        return tuple(replace(camera, cam_from_world=pose) for pose in moved)


@pytree
@dataclass(frozen=True)
class Color(Plain):
    """A colour camera. Its measurement is an image [h w 3], display-referred (sRGB), in [0, 1].

    Attributes:
        noise: exposure and noise; None for the picture as `render` draws it.
        blur: motion blur; None for a short exposure. A rolling shutter is the motion of the camera itself.
    """

    noise: ColorNoise | None = None
    blur: MotionBlur | None = None

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return ("rgb",)

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """Returns the views to average."""
        return (camera,) if self.blur is None else self.blur.views(camera)

    def read(
        self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None
    ) -> Float[Array, "h w 3"]:
        """Returns the image. Views are averaged, and noise is added, in linear light."""
        if len(drawn) == 1 and self.noise is None:
            return jnp.clip(drawn[0].rgb, 0, 1)
        light = jnp.mean(jnp.stack([to_linear(each.rgb) for each in drawn]), axis=0)
        return to_display(light if self.noise is None else self.noise.apply(light, key))


def to_linear(rgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the linear light of display-referred (sRGB) values, which are clipped to [0, 1]."""
    value = jnp.clip(rgb, 0, 1)
    bright = value > TOE
    curve = ((jnp.where(bright, value, 1) + OFFSET) / (1 + OFFSET)) ** POWER
    return jnp.where(bright, curve, value / SLOPE)


def to_display(light: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the display-referred (sRGB) values of linear light, which is clipped to [0, 1]."""
    value = jnp.clip(light, 0, 1)
    bright = value > TOE / SLOPE
    curve = (1 + OFFSET) * jnp.where(bright, value, 1) ** (1 / POWER) - OFFSET
    return jnp.where(bright, curve, value * SLOPE)
