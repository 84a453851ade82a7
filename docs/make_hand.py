"""Makes a capture of a hand for `splatax rig`: `python docs/make_hand.py right.glb FOLDER`.

right.glb is the hand of @webxr-input-profiles/assets (MIT, npm), profiles/generic-hand. Its surface gets a
procedural texture and is photographed without light in ten poses. FOLDER gets transforms.json, images,
poses.json, and body.glb with a clip "Fist", in which the fingers close one after another and open again.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from splatax.demo.posed_capture import write_posed_capture
from splatax.io.rigs import read_body
from splatax.scene.body import Body
from splatax.scene.clips import Channel, Clip
from splatax.scene.skeleton import Pose, Skeleton

FINGERS = ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger")
BONES = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
POSES, HELD_OUT, VIEWS, SIZE = 10, 2, 6, 128
SECONDS, KEYS, CURL, DELAY = (
    3.0,
    25,
    1.1,
    0.12,
)  # of the clip; radians of each bone, and fraction between fingers


def connected(body: Body) -> Body:
    """Returns the hand with the joints of each finger, which hang on one node in the file, in a chain."""
    skeleton = body.skeleton
    parents = dict(zip(skeleton.names, (skeleton.names[max(p, 0)] for p in skeleton.parents), strict=True))
    for finger in FINGERS:
        chain = [f"{finger}-{bone}" for bone in BONES if f"{finger}-{bone}" in skeleton.names]
        parents |= dict(zip(chain, ["wrist", *chain], strict=False))
    above = tuple(
        -1 if skeleton.parents[i] < 0 else skeleton.names.index(parents[name])
        for i, name in enumerate(skeleton.names)
    )
    worlds = np.asarray(skeleton.worlds(skeleton.rest), np.float64)
    root = np.asarray(skeleton.root, np.float64)
    locals_ = np.stack(
        [np.linalg.inv(worlds[p] if p >= 0 else root) @ w for w, p in zip(worlds, above, strict=True)]
    )
    scales = np.linalg.norm(locals_[:, :3, :3], axis=1)
    quats = Rotation.from_matrix(locals_[:, :3, :3] / scales[:, None]).as_quat()[:, [3, 0, 1, 2]]
    rest = Pose(*(jnp.asarray(rows, jnp.float32) for rows in (locals_[:, :3, 3], quats, scales)))
    return replace(body, skeleton=replace(skeleton, rest=rest, parents=above))


def curled(skeleton: Skeleton, angles: dict[str, float]) -> Pose:
    """Returns a pose with the three bones of each finger bent by an angle, radians."""
    return skeleton.turned(
        {
            name: jnp.array([-angle, 0.0, 0.0])
            for finger, angle in angles.items()
            for name in skeleton.names
            if name.startswith(finger) and "phalanx" in name
        }
    )


def fist(skeleton: Skeleton) -> Clip:
    """Returns a clip in which the fingers close one after another, and open again."""
    times = np.linspace(0, SECONDS, KEYS)
    quats = []
    for time in times / SECONDS:
        late = np.arange(len(FINGERS))[::-1] * DELAY / 2
        phases = np.clip((time - late) / (1 - late.max()), 0, 1)
        angles = CURL * np.sin(np.pi * phases) ** 2
        quats.append(np.asarray(curled(skeleton, dict(zip(FINGERS, angles, strict=True))).quats))
    values = np.stack(quats, axis=1)[:, :, None]
    moving = [i for i, name in enumerate(skeleton.names) if "phalanx" in name]
    channels = (Channel(i, "rotation", times, values[i].astype(np.float64), "LINEAR") for i in moving)
    return Clip("Fist", tuple(channels))


def main(path: str, folder: str) -> None:
    body, rng = connected(read_body(path)), np.random.default_rng(1)
    body = replace(body, clips={"Fist": fist(body.skeleton)})
    poses = {
        f"pose{i}": curled(body.skeleton, {finger: rng.uniform(0, CURL) for finger in FINGERS})
        for i in range(POSES)
    }
    held_out = tuple(poses)[-HELD_OUT:]
    write_posed_capture(Path(folder), body, poses, held_out, SIZE, VIEWS, elevations=(-0.7, 0.7))


if __name__ == "__main__":
    main(*sys.argv[1:])
