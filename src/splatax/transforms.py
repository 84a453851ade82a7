"""Similarity transforms of scenes. Transforming Gaussians and cameras alike keeps renderings the same."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.math import harmonics, quaternions, rigid

GENERIC = np.array([0.36, 0.48, 0.8])  # a direction at which no harmonic up to degree 4 is zero


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Similarity:
    """A similarity transform of space, p' = scale R p + t.

    It is a pytree of three arrays, which pass through `jit`, `grad` and `vmap`. Poses that are made of NumPy
    arrays and Python numbers are computed in double precision on the host. Values are checked where they are
    known, which traced values are not.

    Attributes:
        rotation: R, a rotation matrix.
        translation: t, world units after scaling.
        scale: a factor above zero.
    """

    rotation: Float[np.ndarray, "3 3"] | Float[Array, "3 3"]
    translation: Float[np.ndarray, "3"] | Float[Array, "3"]
    scale: float | Float[Array, ""] = 1.0

    def __post_init__(self) -> None:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in self._leaves()):
            return
        shapes = np.shape(self.rotation), np.shape(self.translation), np.shape(self.scale)
        if shapes != ((3, 3), (3,), ()):
            raise ValueError(
                f"rotation, translation and scale have the shapes {', '.join(map(str, shapes))}. They must "
                "have (3, 3), (3,) and (); a 4 x 4 matrix has them in matrix[:3, :3] and matrix[:3, 3]."
            )
        if not (np.isfinite(self.translation).all() and 0 < self.scale < np.inf):
            raise ValueError(
                f"scale {self.scale} and translation {self.translation}: must be finite, scale > 0"
            )
        rotation = np.asarray(self.rotation)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5):
            raise ValueError("not a rotation: its axes are not orthogonal and of length one")
        if np.linalg.det(rotation) < 0:
            raise ValueError("a reflection, which would mirror the scene, is not a rotation")

    def _leaves(self) -> tuple[Any, ...]:
        return self.rotation, self.translation, self.scale

    def tree_flatten_with_keys(self):
        """Returns the arrays by name, for JAX."""
        named = (jax.tree_util.GetAttrKey(field.name) for field in fields(self))
        return tuple(zip(named, self._leaves(), strict=True)), None

    @classmethod
    def tree_unflatten(cls, _: None, leaves: Iterable[Any]) -> "Similarity":
        """Returns the transform with other leaves, which JAX may stack or replace by placeholders."""
        made = object.__new__(cls)
        for field, leaf in zip(fields(cls), leaves, strict=True):
            object.__setattr__(made, field.name, leaf)
        return made

    @classmethod
    def of(
        cls,
        *,
        degrees: tuple[float, float, float] = (0, 0, 0),
        scale: float = 1.0,
        move: tuple[float, float, float] = (0, 0, 0),
    ) -> "Similarity":
        """Returns the transform that rotates, then scales, then translates.

        Args:
            degrees: angles of rotation about the world's x axis, then its y axis, then its z axis.
            scale: a factor above zero.
            move: the translation, world units after scaling.
        """
        from scipy.spatial.transform import Rotation  # slow to import; the renderer does without

        rotation = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
        return cls(rotation, np.array(move, np.float64), scale)

    @classmethod
    def from_quat(
        cls,
        quat: Float[Array, "4"],
        translation: Float[Array, "3"],
        scale: float | Float[Array, ""] = 1.0,
    ) -> "Similarity":
        """Returns the transform whose rotation is a quaternion (w, x, y, z) of any length. Traceable."""
        return cls(quaternions.to_rotation(quat), translation, scale)

    @classmethod
    def from_twist(cls, twist: Float[Array, "6"]) -> "Similarity":
        """Returns the rigid motion of a twist, rotation (radians) before translation; see `math.rigid`.

        It has a derivative everywhere, so a pose can be optimized as `Similarity.from_twist(x).after(guess)`.
        """
        motion = rigid.exponential(twist)
        return cls(motion[:3, :3], motion[:3, 3])

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The transform of homogeneous coordinates, in double precision. The numbers must be known."""
        found = np.eye(4)
        found[:3, :3] = float(self.scale) * np.asarray(self.rotation, np.float64)
        found[:3, 3] = np.asarray(self.translation, np.float64)
        return found

    @property
    def on_host(self) -> bool:
        """True if all numbers are NumPy's or Python's, which are computed in double precision."""
        return not any(isinstance(leaf, jax.Array) for leaf in self._leaves())

    def cast(self, dtype: Any) -> "Similarity":
        """Returns the transform with JAX arrays of a dtype."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), self)

    @jax.default_matmul_precision("highest")
    def after(self, first: "Similarity") -> "Similarity":
        """Returns the composition that applies `first`, and then this transform."""
        arrays = [leaf for leaf in (*self._leaves(), *first._leaves()) if isinstance(leaf, jax.Array)]
        a, b = (place.cast(arrays[0].dtype) if arrays else place for place in (self, first))
        translation = a.scale * (a.rotation @ b.translation) + a.translation
        return Similarity(a.rotation @ b.rotation, translation, a.scale * b.scale)

    @jax.default_matmul_precision("highest")
    def inverse(self) -> "Similarity":
        """Returns the transform that undoes this one."""
        back = self.rotation.T
        return Similarity(back, -(back @ self.translation) / self.scale, 1 / self.scale)

    def transform(self, gaussians: Gaussians) -> Gaussians:
        """Returns the transformed scene, with rotated spherical harmonics (see `harmonics.rotation`)."""
        if not self.on_host or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(gaussians)):
            return _transformed(self.cast(gaussians.means.dtype), gaussians)
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat()
        turn = jnp.asarray([w, x, y, z], gaussians.quats.dtype)
        turned = np.asarray(gaussians.means, np.float64) @ self.rotation.T
        blocks = harmonics.rotation(self.rotation, gaussians.sh_degree)
        sh = np.einsum("kj,njc->nkc", blocks.astype(np.float32), np.asarray(gaussians.sh), optimize=True)
        return replace(
            gaussians,
            means=jnp.asarray(self.scale * turned + self.translation, gaussians.means.dtype),
            quats=jax.vmap(quaternions.multiply, (None, 0))(turn, gaussians.quats),
            log_scales=jnp.asarray(np.asarray(gaussians.log_scales) + np.float32(np.log(self.scale))),
            opacity_logits=gaussians.opacity_logits,
            sh=jnp.asarray(sh, gaussians.sh.dtype),
        )

    def transform_camera(self, camera: Camera) -> Camera:
        """Returns the camera that sees the transformed scene as `camera` sees the scene; depths scale.

        Its motion during the exposure scales too, and so does what parallel rays cover. Traceable. A pose and
        a transform that are known are composed in double precision on the host.
        """
        pose = camera.cam_from_world
        if any(isinstance(leaf, jax.core.Tracer) for leaf in (*self._leaves(), pose)):
            moved = _moved(self.cast(pose.dtype), pose)
        else:
            rotation, translation = (np.asarray(x, np.float64) for x in (self.rotation, self.translation))
            known = Similarity(rotation, translation, float(self.scale))
            moved = _moved(known, np.asarray(pose, np.float64))
        camera = replace(camera, cam_from_world=jnp.asarray(moved, pose.dtype))
        scale = jnp.asarray(self.scale, pose.dtype)
        if camera.motion is not None:
            twist = jnp.concatenate([camera.motion.twist[:3], scale * camera.motion.twist[3:]])
            camera = replace(camera, motion=replace(camera.motion, twist=twist))
        if not camera.lens.CENTRAL:  # focal lengths are pixels for a world unit
            camera = replace(camera, fx=camera.fx / scale, fy=camera.fy / scale)
        return camera


@jax.default_matmul_precision("highest")
def _moved(place: Similarity, pose: Any) -> Any:
    """Returns the pose of a camera in a transformed scene, in the arithmetic of its arrays."""
    rotation = pose[:3, :3] @ place.rotation.T
    translation = place.scale * pose[:3, 3] - rotation @ place.translation
    arrays = jnp if isinstance(rotation, jax.Array) else np
    top = arrays.concatenate([rotation, translation[:, None]], axis=1)
    return arrays.concatenate([top, pose[3:]])


@jax.default_matmul_precision("highest")
def _transformed(place: Similarity, gaussians: Gaussians) -> Gaussians:
    """Transforms Gaussians with a traced transform, in their dtype."""
    turn = quaternions.from_rotation(jnp.asarray(place.rotation))
    blocks = harmonics.rotation(place.rotation, gaussians.sh_degree)
    return replace(
        gaussians,
        means=place.scale * (gaussians.means @ place.rotation.T) + place.translation[None],
        quats=jax.vmap(quaternions.multiply, (None, 0))(turn, gaussians.quats),
        log_scales=gaussians.log_scales + jnp.log(place.scale),
        sh=jnp.einsum("kj,njc->nkc", blocks, gaussians.sh),
    )


def half_turn(gaussians: Gaussians, axis: int) -> Gaussians:
    """Returns the scene rotated by 180 degrees about the world's axis 0, 1 or 2, without rounding.

    Only signs change. The rotation converts between frames of computer graphics: about x between
    right-down-forward (COLMAP) and right-up-back (OpenGL), about z to left-up-forward.
    """
    signs = np.where(np.arange(3) == axis, np.float32(1), np.float32(-1))
    degree = gaussians.sh_degree
    here, there = (
        np.asarray(harmonics.basis(jnp.asarray(d, jnp.float32), degree)) for d in (GENERIC, signs * GENERIC)
    )
    factors = {"means": signs, "quats": np.insert(signs, 0, 1), "sh": np.sign(here * there)[:, None]}
    turned: dict[str, Any] = {
        name: jnp.asarray(np.asarray(getattr(gaussians, name)) * f) for name, f in factors.items()
    }
    return replace(gaussians, **turned)
