"""Files of synthetic captures: bodies in several poses."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from splatax.demo.rigged import camera_around, drawn_arm, posed_dataset
from splatax.io import images
from splatax.io.rigs.poses import Posing, write_poses
from splatax.io.rigs.writing import save_body
from splatax.scene.body import Body
from splatax.scene.skeleton import Pose

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: y down, z forward -> y up, z back
HELD_OUT = ("pose3", "pose6")


def write_arm_capture(folder: str | Path, size: int = 128, poses: int = 8, views: int = 5) -> None:
    """Writes photos of an arm in several poses, with all that `splatax rig` needs.

    FOLDER/transforms.json and FOLDER/images are the capture, FOLDER/body.glb is the arm with its skeleton and
    the clip "Wave", and FOLDER/poses.json is the pose in each photo. The photos of two poses are held out.

    Args:
        folder: to write to.
        size: width and height of the photos, pixels.
        poses: number of poses, at equal steps of the clip.
        views: photos of each pose, from sides that are chosen at random.
    """
    body = drawn_arm()
    clip, rest = body.clips["Wave"], body.skeleton.rest
    times = np.linspace(0, clip.seconds, poses, endpoint=False)
    named = {f"pose{i}": clip.pose(rest, float(time)) for i, time in enumerate(times)}
    write_posed_capture(Path(folder), body, named, HELD_OUT, size, views)


def write_posed_capture(
    folder: Path,
    body: Body,
    poses: Mapping[str, Pose],
    held_out: Collection[str],
    size: int,
    views: int,
    elevations: tuple[float, float] = (-0.3, 0.7),
) -> None:
    """Writes photos of a body in several poses, and the other files of `write_arm_capture`.

    Args:
        folder: to write to.
        body: with its clips.
        poses: by name.
        held_out: names of the poses whose photos are held out.
        size: width and height of the photos, pixels.
        views: photos of each pose, from sides that are chosen at random.
        elevations: lowest and highest angle of a camera above the horizon, radians.
    """
    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    photos, pose_of = {}, {}
    for name, pose in poses.items():
        for number in range(views):
            photo = f"{name}-{number}.png"
            camera = camera_around(body, rng.uniform(0, 2 * np.pi), rng.uniform(*elevations), size)
            photos[photo], pose_of[photo] = (pose, camera), name
    hidden = [photo for photo, name in pose_of.items() if name in held_out]
    frames = []
    for view in posed_dataset(body, photos).train:
        images.write(folder / "images" / view.name, view.pixels())
        world = np.linalg.inv(np.asarray(view.camera.cam_from_world, np.float64)) @ TO_OPENGL
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": world.tolist()})
    focal = float(next(iter(photos.values()))[1].fx)
    lens = {"fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2, "w": size, "h": size}
    contents = {**lens, "frames": frames, "test_filenames": [f"images/{photo}" for photo in hidden]}
    (folder / "transforms.json").write_text(json.dumps(contents, indent=1))
    save_body(folder / "body.glb", body)
    write_poses(folder / "poses.json", Posing(dict(poses), pose_of), body.skeleton)
