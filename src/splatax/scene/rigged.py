"""Rigged scenes: Gaussians or parts, their rigs and the clips that move them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax
import numpy as np

from splatax.gaussians import Gaussians
from splatax.scene.clips import Clip
from splatax.scene.parts import Scene
from splatax.scene.skeleton import Pose, Skeleton
from splatax.scene.skin import Rig, skin


@dataclass(frozen=True)
class RiggedScene:
    """Gaussians that follow a skeleton.

    Attributes:
        gaussians: in the bound pose.
        rig: the skeleton, and the joints that each Gaussian follows.
        clips: motions of the skeleton, by name.
    """

    gaussians: Gaussians
    rig: Rig
    clips: Mapping[str, Clip] = field(default_factory=dict)

    def posed(self, pose: Pose) -> Gaussians:
        """Returns the Gaussians in a pose."""
        return skin(self.gaussians, self.rig, self.rig.skeleton.worlds(pose))

    def at(self, clip: str, time: float) -> Gaussians:
        """Returns the Gaussians at a time of a clip, seconds.

        Raises:
            KeyError: if there is no such clip.
        """
        return self.posed(self.clips[clip].pose(self.rig.skeleton.rest, time))


@dataclass(frozen=True)
class AnimatedScene:
    """A scene of parts, of which some follow one skeleton and the others stay.

    Attributes:
        scene: the parts. Those that follow the skeleton are in the bound pose; the pose of such a part places
            it after the skeleton has moved it.
        rigs: rigs of these parts by their names. All have the same skeleton. May be empty.
        clips: motions of the skeleton, by name.
    """

    scene: Scene
    rigs: Mapping[str, Rig]
    clips: Mapping[str, Clip] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, rig in self.rigs.items():
            part = self.scene[name]
            if len(rig.indices) != len(part.gaussians):
                raise ValueError(
                    f"part {name!r} has {len(part.gaussians):,} Gaussians, and its rig {len(rig.indices):,}."
                )
            if not _same(rig.skeleton, self.skeleton):
                raise ValueError(f"part {name!r} follows another skeleton than {next(iter(self.rigs))!r}.")

    @property
    def skeleton(self) -> Skeleton:
        """The joints.

        Raises:
            ValueError: if no part follows a skeleton.
        """
        if not self.rigs:
            raise ValueError(f"no part follows a skeleton: {', '.join(self.scene.names)} stay.")
        return next(iter(self.rigs.values())).skeleton

    def posed(self, pose: Pose) -> Scene:
        """Returns the parts in a pose of the skeleton."""
        joints = self.skeleton.worlds(pose)
        moved = {
            name: replace(self.scene[name], gaussians=skin(self.scene[name].gaussians, rig, joints))
            for name, rig in self.rigs.items()
        }
        return self.scene.replaced(moved)

    def at(self, clip: str, time: float) -> Scene:
        """Returns the parts at a time of a clip, seconds.

        Raises:
            KeyError: if there is no such clip.
        """
        return self.posed(self.clips[clip].pose(self.skeleton.rest, time))


def _same(a: Skeleton, b: Skeleton) -> bool:
    """Returns whether two skeletons have the same joints in the same places."""
    if a is b:
        return True
    if (a.names, a.parents) != (b.names, b.parents):
        return False
    return all(np.allclose(x, y, atol=1e-6) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))
