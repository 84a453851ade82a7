"""Captures on disk for tests, written by pycolmap itself."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

SIZE = (64, 48)
POINTS = np.random.default_rng(0).uniform(-1, 1, (30, 3))


def pinhole(camera_id=1, size=SIZE):
    return pycolmap.Camera(
        model="PINHOLE", width=size[0], height=size[1], params=[60, 61, 30, 25], camera_id=camera_id
    )


def radial(camera_id=1):
    return pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[60, 32, 24, 0.05], camera_id=camera_id
    )


def pose_of(i) -> pycolmap.Rigid3d:
    rotation = pycolmap.Rotation3d(np.array([0, 0.02 * i, 0, 1]) / np.hypot(0.02 * i, 1))
    return pycolmap.Rigid3d(rotation, np.array([0.1 * i, 0, 0]))


def model_of(names, camera) -> pycolmap.Reconstruction:
    """Cameras in a row that look along z at points around the origin; observations are exact."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    ids = [
        model.add_point3D(p + [0, 0, 5], pycolmap.Track(), np.array([10, 20, 30], np.uint8)) for p in POINTS
    ]
    for i, name in enumerate(names, start=1):
        pose = pose_of(i)
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=i)
        image.points2D = [pycolmap.Point2D(camera.img_from_cam(pose * model.point3D(j).xyz)) for j in ids]
        model.add_image_with_trivial_frame(image, pose)
        for k, j in enumerate(ids):
            model.add_observation(j, pycolmap.TrackElement(i, k))
    return model


def write_capture(folder: Path, count=9, camera=None, text=False, size=SIZE, mode="RGB") -> Path:
    names = [f"photo{i:02}.png" for i in range(count)]
    model = model_of(names, camera or pinhole())
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(sparse)
    (folder / "images").mkdir()
    rng = np.random.default_rng(1)
    for name in names:
        pixels = rng.integers(0, 255, (size[1], size[0], len(mode)), np.uint8)
        Image.fromarray(pixels, mode).save(folder / "images" / name)
    return folder


TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # columns of a camera-to-world matrix
POSES = [np.vstack([pose_of(i).matrix(), [0, 0, 0, 1]]) for i in range(1, 10)]  # those of `model_of`


def write_photos(folder: Path, names, size=SIZE, mode="RGB") -> None:
    rng = np.random.default_rng(1)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = rng.integers(0, 255, (size[1], size[0], len(mode)), np.uint8)
        Image.fromarray(pixels, mode).save(folder / name)


def frame(name, pose, **entries) -> dict:
    return {"file_path": name, "transform_matrix": (np.linalg.inv(pose) @ TO_OPENGL).tolist(), **entries}


def write_transforms(folder: Path, count=9, size=SIZE, photo_size=SIZE, **entries) -> Path:
    """The capture of `write_capture` as nerfstudio would write it."""
    names = [f"images/photo{i:02}.png" for i in range(count)]
    write_photos(folder, names, photo_size)
    contents = {"fl_x": 60, "fl_y": 61, "cx": 30, "cy": 25, "w": size[0], "h": size[1]}
    frames = [frame(name, pose) for name, pose in zip(names, POSES, strict=False)]
    (folder / "transforms.json").write_text(json.dumps(contents | {"frames": frames} | entries))
    return folder


def write_blender(folder: Path, splits=("train", "test"), count=3) -> Path:
    """RGBA photos, named without their suffix."""
    for split in splits:
        names = [f"{split}/r_{i}" for i in range(count)]
        write_photos(folder, [f"{name}.png" for name in names], mode="RGBA")
        frames = [frame(f"./{name}", pose) for name, pose in zip(names, POSES, strict=False)]
        contents = {"camera_angle_x": 0.8, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(contents))
    return folder


def write_llff(folder: Path, count=9, size=(128, 96)) -> Path:
    """Poses for photos of `size`; those on disk have `SIZE`."""
    write_photos(folder / "images", [f"IMG_{i:02}.png" for i in range(count)])
    rows = []
    for pose in POSES[:count]:
        right, down, forward, position = np.linalg.inv(pose)[:3].T
        matrix = np.stack([down, right, -forward, position, [size[1], size[0], 120]], axis=1)
        rows.append([*matrix.ravel(), 1, 9])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def zipped(folder: Path, to: Path) -> Path:
    with zipfile.ZipFile(to, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))
    return to
