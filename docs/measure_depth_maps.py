"""Measures what given depth maps add to `--geometry`, beside points, and beside neither.

python docs/measure_depth_maps.py FOLDER [STEPS [CAPTURES]]

The demo is written as three captures: FOLDER/points as COLMAP writes it, and FOLDER/maps and FOLDER/nothing
as nerfstudio does. That in FOLDER/maps names a depth map for each photo in `depth_file_path`: exact, in whole
millimetres in a 16-bit picture, if a world unit is a metre. All start from the same points. The script runs
`splatax train --geometry` on each of them, or on those named, with 2,000 steps by default, and prints rows of
the table in docs/geometry.md.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import splatax as sx
from splatax.cli import main as splatax
from splatax.demo.capture import write_capture
from splatax.geometry_scores import DEPTHS

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # columns of a camera-to-world matrix
DEFAULTS = 2_000, "maps,points,nothing"  # steps and captures
TRUTH = "truth"


def main(folder: Path, steps: int, captures: list[str]) -> None:
    points = folder / "points"
    write_capture(points)
    for name, maps in (("maps", True), ("nothing", False)):
        write_transforms(folder / name, points, maps)
    for name in captures:
        out = folder / f"{name}-run"
        splatax(["train", str(folder / name), "--geometry", "--steps", str(steps), "--out", str(out)])
        metrics = json.loads((out / "metrics.json").read_text())
        found = metrics["geometry"]
        assert found["reference"] == TRUTH
        columns = [name, f"{metrics['test']['psnr']:.2f}"]
        for output in DEPTHS:
            errors = found["depth"][output]
            columns.append(
                f"{output} {errors['error']:.4f}, {errors['bias']:+.4f}, {100 * errors['capped_error']:.2f} %"
            )
        print(" | ".join([*columns, f"{found['normal_error']:.1f} degrees"]), flush=True)


def write_transforms(folder: Path, colmap: Path, maps: bool) -> None:
    """Writes a capture of COLMAP with true geometry as nerfstudio would, with or without depth maps."""
    dataset = sx.load_dataset(colmap)
    for part in ("images", TRUTH):
        shutil.copytree(colmap / part, folder / part, dirs_exist_ok=True)
    (folder / "depth").mkdir(exist_ok=True)
    frames = []
    for view in dataset.views:
        pose = np.asarray(view.camera.cam_from_world, np.float64)
        frame = {
            "file_path": f"images/{view.name}",
            "transform_matrix": (np.linalg.inv(pose) @ TO_OPENGL).tolist(),
        }
        if maps:
            assert view.truth
            name = f"depth/{Path(view.name).stem}.png"
            millimetres = np.round(1000 * view.truth().depth).astype(np.uint16)
            Image.fromarray(millimetres).save(folder / name)
            frame["depth_file_path"] = name
        frames.append(frame)
    camera = dataset.views[0].camera
    numbers = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    contents = {name: float(number) for name, number in numbers.items()}
    contents |= {"w": camera.width, "h": camera.height, "ply_file_path": "points.ply", "frames": frames}
    contents["test_filenames"] = [f"images/{view.name}" for view in dataset.test]
    (folder / "transforms.json").write_text(json.dumps(contents, indent=1))
    write_points(folder / "points.ply", dataset.points)


def write_points(path: Path, points: sx.PointCloud) -> None:
    """Writes coloured points as text."""
    colors = np.round(255 * points.colors).astype(int)
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {color}" for color in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    rows = [
        " ".join(map(str, (*position, *color)))
        for position, color in zip(points.positions.tolist(), colors.tolist(), strict=True)
    ]
    path.write_text("\n".join([*header, *rows]) + "\n")


if __name__ == "__main__":
    total, chosen = (*sys.argv[2:], *DEFAULTS[len(sys.argv[2:]) :])
    main(Path(sys.argv[1]), int(total), str(chosen).split(","))
