"""Clips: recorded motions of a skeleton, as glTF stores them."""

from dataclasses import astuple, dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.scene.skeleton import Pose

Path = Literal["translation", "rotation", "scale"]
Interpolation = Literal["LINEAR", "STEP", "CUBICSPLINE"]


@dataclass(frozen=True)
class Channel:
    """The motion of one property of one joint.

    Attributes:
        joint: index of the joint.
        path: the property. Rotations are quaternions (w, x, y, z).
        times: seconds, ascending, at least one.
        values: one row for each time; for CUBICSPLINE three: in-tangent, value and out-tangent.
        interpolation: between the times. Before the first and after the last, the value stays.
    """

    joint: int
    path: Path
    times: Float[np.ndarray, " t"]
    values: Float[np.ndarray, "t r c"]
    interpolation: Interpolation

    def at(self, time: float) -> Float[np.ndarray, " c"]:
        """Returns the value at a time in seconds; rotations are unit quaternions."""
        keys = self.values[:, len(self.values[0]) // 2]  # without tangents
        after = int(np.searchsorted(self.times, time, side="right"))
        if after == 0 or after == len(self.times):
            return self._unit(keys[max(after - 1, 0)])
        before, span = after - 1, self.times[after] - self.times[after - 1]
        fraction = (time - self.times[before]) / span
        if self.interpolation == "STEP":
            return self._unit(keys[before])
        if self.interpolation == "LINEAR":
            if self.path == "rotation":
                return slerp(self._unit(keys[before]), self._unit(keys[after]), fraction)
            return (1 - fraction) * keys[before] + fraction * keys[after]
        t, leaving, arriving = fraction, self.values[before, 2] * span, self.values[after, 0] * span
        value = (2 * t**3 - 3 * t**2 + 1) * keys[before] + (t**3 - 2 * t**2 + t) * leaving
        return self._unit(value + (3 * t**2 - 2 * t**3) * keys[after] + (t**3 - t**2) * arriving)

    def _unit(self, value: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        return value / np.linalg.norm(value) if self.path == "rotation" else value


def slerp(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"], fraction: float) -> Float[np.ndarray, "4"]:
    """Returns the rotation at a fraction of the shortest way from one unit quaternion to another."""
    cosine = float(a @ b)
    b, cosine = (b, cosine) if cosine >= 0 else (-b, -cosine)
    if cosine > 1 - 1e-9:
        mixed = (1 - fraction) * a + fraction * b
        return mixed / np.linalg.norm(mixed)
    angle = np.arccos(min(cosine, 1.0))
    return (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)


@dataclass(frozen=True)
class Clip:
    """A motion of a skeleton. Properties without a channel stay as in the rest pose.

    Attributes:
        name: name in the file.
        channels: at most one for each property of each joint.
    """

    name: str
    channels: tuple[Channel, ...]

    @property
    def seconds(self) -> float:
        """The last time of any channel; 0 without channels."""
        return max((float(channel.times[-1]) for channel in self.channels), default=0.0)

    def equals(self, other: "Clip") -> bool:
        """Returns whether two clips have the same name and move the same joints in the same way."""
        return (
            self.name == other.name
            and len(self.channels) == len(other.channels)
            and all(
                np.array_equal(one, another)
                for ours, theirs in zip(self.channels, other.channels, strict=True)
                for one, another in zip(astuple(ours), astuple(theirs), strict=True)
            )
        )

    def pose(self, rest: Pose, time: float) -> Pose:
        """Returns the pose at a time.

        Args:
            rest: of the skeleton.
            time: seconds; the first and the last pose hold before and after the clip.
        """
        values = {
            "translation": np.array(rest.translations),
            "rotation": np.array(rest.quats),
            "scale": np.array(rest.scales),
        }
        for channel in self.channels:
            values[channel.path][channel.joint] = channel.at(time)
        return Pose(*(jnp.asarray(rows, jnp.float32) for rows in values.values()))
