"""`CameraRig`: cameras that are fixed to one body and move with it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp

from splatax.cameras import Camera, checked
from splatax.pytrees import pytree
from splatax.transforms import Similarity

RIGID = 1e-5  # difference of a scale from 1 that is rounding


@pytree
@dataclass(frozen=True)
class CameraRig:
    """Cameras of one size and one kind of lens, which are drawn together by `vmap`.

    Attributes:
        cameras: one `Camera` whose arrays have a leading axis, one entry for each camera. Poses are relative
            to the body: `cam_from_world` is `cam_from_body`.
        names: names of the cameras, in their order (static).
    """

    cameras: Camera
    names: tuple[str, ...] = field(metadata={"static": True})

    @classmethod
    def of(cls, cameras: Sequence[Camera], names: Sequence[str] = ()) -> "CameraRig":
        """Returns the rig of some cameras, whose world is the body.

        Args:
            cameras: one or more, of one size and one kind of lens and motion.
            names: their names; "0", "1" and so on if there are none.

        Raises:
            ValueError: if there is no camera, their kinds differ, or the names are not as many.
        """
        if not cameras:
            raise ValueError("a rig without cameras. Give at least one.")
        if len({jax.tree.structure(checked(camera)) for camera in cameras}) > 1:
            raise ValueError(
                "the cameras of a rig differ in image size, kind of lens or motion, so they cannot be drawn "
                "together. Make one rig for each kind."
            )
        chosen = tuple(names) or tuple(map(str, range(len(cameras))))
        if len(chosen) != len(cameras):
            raise ValueError(f"a rig of {len(cameras)} cameras has {len(chosen)} names. Give one for each.")
        return cls(jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras), chosen)

    def __len__(self) -> int:
        """Returns the number of cameras."""
        return len(self.names)

    @jax.default_matmul_precision("highest")
    def at(self, world_from_body: Similarity) -> "CameraRig":
        """Returns the rig with its body at a pose, so that `cam_from_world` holds. Traceable.

        Args:
            world_from_body: rigid transform; its scale must be 1, because cameras are not scaled.

        Raises:
            ValueError: if the scale is known and is not 1.
        """
        scale = world_from_body.scale
        if not isinstance(scale, jax.core.Tracer) and abs(float(scale) - 1) > RIGID:
            raise ValueError(
                f"a body with the scale {float(scale):g}, and cameras are not scaled. Give a rigid transform."
            )
        poses = self.cameras.cam_from_world
        place = world_from_body.cast(poses.dtype)
        back = place.rotation.T
        top = jnp.concatenate([back, -(back @ place.translation)[:, None]], axis=1)
        body_from_world = jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], poses.dtype)])
        return replace(self, cameras=replace(self.cameras, cam_from_world=jnp.matmul(poses, body_from_world)))
