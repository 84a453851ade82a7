"""Rigged scenes: Gaussians, their rig and its clips."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from splatax.gaussians import Gaussians
from splatax.scene.clips import Clip
from splatax.scene.skeleton import Pose
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
