"""Captures as other programs write them, made from known cameras by each format's published convention.

A writer makes a folder with a photo for each camera, and returns the projection of that format: a function
of the camera's number and a point of the world, in pixels from the photo's corner. The photos show a dot
wherever that projection has a point of `POINTS`.
"""

import json
from xml.etree import ElementTree as Xml

import numpy as np
from PIL import Image
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = SIZE = (160, 120)
EYES = ((2.0, 0.5, 1.0), (-1.6, 1.3, 1.2), (0.3, -2.2, 0.8))
ROLLS = (0.2, -0.3, 2.0)
POINTS = np.array(
    [[0.6, 0.8, 0.1], [-0.5, -0.3, -0.6], [0.2, -0.8, 0.5], [-0.6, -0.7, -0.3], [-0.2, -0.7, 0.3]]
)
NAMES = [f"photo{i}.png" for i in range(len(EYES))]
FOCAL, K1, K2 = 130.0, -0.12, 0.05
DEPTH = 1.75  # metres, of every pixel of a depth map
OPENGL = np.diag([1.0, -1.0, -1.0])


def world_from_cam(i):
    """Rotation (columns: right, down, forward) and centre of a camera that looks at the origin."""
    eye = np.array(EYES[i])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return rotation @ Rotation.from_rotvec([0, 0, ROLLS[i]]).as_matrix(), eye


def in_camera(i, point):
    rotation, eye = world_from_cam(i)
    return rotation.T @ (point - eye)


def before_distortion(i, point, kind):
    """Where a lens of no distortion shows a point, at focal length 1."""
    x, y, z = in_camera(i, point)
    x, y = x / z, y / z
    if kind != "fisheye":
        return x, y
    r = np.hypot(x, y)
    return x * np.arctan(r) / r, y * np.arctan(r) / r


def write_photos(folder, project, names=NAMES):
    """Photos with a small round dot at the projection of each point."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for i, name in enumerate(names):
        picture = np.zeros((HEIGHT, WIDTH))
        for point in POINTS:
            u, v = project(i, point)
            picture += np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.5**2))
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)).convert("RGB").save(path)


def write_ply(path, positions):
    header = f"ply\nformat ascii 1.0\nelement vertex {len(positions)}\n"
    header += "".join(f"property float {c}\n" for c in "xyz")
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    path.write_text(header + "".join(f"{x} {y} {z} 10 20 30\n" for x, y, z in positions))


def metashape(folder, kind="frame", names=NAMES, **extra):
    """Labels without suffix, as Metashape's own; the chunk has a rotation, a translation and a scale."""
    turn, shift, scale = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), np.array([5.0, -3.0, 2.0]), 2.5
    values = {"f": FOCAL, "cx": 3.0, "cy": -2.0, "k1": K1, "k2": K2, "k3": 0.01, "p1": 0.004, "p2": -0.006}
    values |= {"b1": 2.0, **extra}

    def project(i, point):
        x, y = before_distortion(i, point, kind)
        r2, get = x * x + y * y, values.get
        radial = 1 + get("k1") * r2 + get("k2") * r2**2 + get("k3") * r2**3
        u = x * radial + get("p1") * (r2 + 2 * x * x) + 2 * get("p2") * x * y
        v = y * radial + get("p2") * (r2 + 2 * y * y) + 2 * get("p1") * x * y
        return (
            WIDTH / 2 + get("cx") + u * get("f") + u * get("b1") + v * get("b2", 0),
            HEIGHT / 2 + get("cy") + v * get("f"),
        )

    write_photos(folder / "images", project)
    document = Xml.Element("document", version="1.5.0")
    chunk = Xml.SubElement(document, "chunk", label="Chunk 1", enabled="true")
    sensor = Xml.SubElement(Xml.SubElement(chunk, "sensors"), "sensor", id="0", label="phone", type=kind)
    for name in ("initial", "adjusted"):
        calibration = Xml.SubElement(sensor, "calibration", {"type": kind, "class": name})
        Xml.SubElement(calibration, "resolution", width=str(WIDTH), height=str(HEIGHT))
        for key, value in values.items() if name == "adjusted" else [("f", 99.0)]:
            Xml.SubElement(calibration, key).text = repr(float(value))
    component = Xml.SubElement(Xml.SubElement(chunk, "components"), "component", id="7")
    transform = Xml.SubElement(component, "transform")
    for key, value in (("rotation", turn), ("translation", shift), ("scale", np.array(scale))):
        Xml.SubElement(transform, key).text = " ".join(map(repr, value.ravel().tolist()))
    cameras = Xml.SubElement(chunk, "cameras")
    group = Xml.SubElement(cameras, "group", id="0", label="Group 1")
    for i, name in enumerate(names):
        rotation, eye = world_from_cam(i)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn.T @ rotation, turn.T @ (eye - shift) / scale
        label = name.removesuffix(".png")
        camera = Xml.SubElement(group, "camera", id=str(i), sensor_id="0", component_id="7", label=label)
        Xml.SubElement(camera, "transform").text = " ".join(map(repr, matrix.ravel().tolist()))
    Xml.SubElement(cameras, "camera", id="9", sensor_id="0", label="never aligned")
    Xml.ElementTree(document).write(folder / "cameras.xml")
    write_ply(folder / "points.ply", POINTS)
    return project


def realitycapture(folder, names=NAMES, k4=0.0):
    f35, px, py, t1, t2 = 29.0, 0.01, -0.02, 0.003, -0.002

    def project(i, point):
        x, y, z = in_camera(i, point)
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + K1 * r2 + K2 * r2**2
        u = x * radial + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)
        v = y * radial + 2 * t2 * x * y + t1 * (r2 + 2 * y * y)
        return (
            WIDTH / 2 + px * WIDTH + f35 / 36 * WIDTH * u,
            HEIGHT / 2 + py * WIDTH + f35 / 36 * WIDTH * v,
        )

    write_photos(folder / "images", project)
    rows = ["#cameras 3", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for i, name in enumerate(names):
        rotation, eye = world_from_cam(i)
        m = rotation @ OPENGL  # = Rz(-heading) Rx(pitch) Ry(roll)
        heading, pitch, roll = np.degrees(
            [np.arctan2(m[0, 1], m[1, 1]), np.arcsin(m[2, 1]), np.arctan2(-m[2, 0], m[2, 2])]
        )
        numbers = [*eye, heading, pitch, roll, f35, px, py, K1, K2, 0, k4, t1, t2]
        rows.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    (folder / "registration.csv").write_text("\n".join(rows) + "\n")
    return project


def pinhole(i, point, focal=(FOCAL, FOCAL + 2), centre=(83.0, 57.0)):
    x, y, z = in_camera(i, point)
    return focal[0] * x / z + centre[0], focal[1] * y / z + centre[1]


def write_depth(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT // 4, WIDTH // 4), round(DEPTH * 1000), np.uint16)).save(path)


def polycam(folder):
    """y is up in the world of the points too: the axes of the world are not changed."""
    stems = [f"12345{i}" for i in range(len(EYES))]
    write_photos(folder / "keyframes" / "corrected_images", pinhole, [f"{stem}.png" for stem in stems])
    for i, stem in enumerate(stems):
        rotation, eye = world_from_cam(i)
        matrix = np.column_stack([rotation @ OPENGL, eye])
        contents = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        contents |= {"fx": FOCAL, "fy": FOCAL + 2, "cx": 83.0, "cy": 57.0, "width": WIDTH, "height": HEIGHT}
        path = folder / "keyframes" / "corrected_cameras" / f"{stem}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(contents | {"blur_score": 80.5, "neighbors": []}))
        write_depth(folder / "keyframes" / "depth" / f"{stem}.png")
    confidence = folder / "keyframes" / "confidence" / f"{stems[0]}.png"
    confidence.parent.mkdir()
    Image.fromarray(np.repeat([[0, 255]], WIDTH // 8, 1).repeat(HEIGHT // 4, 0).astype(np.uint8)).save(
        confidence
    )
    return pinhole


def record3d(folder):
    write_photos(folder / "rgb", pinhole, [f"{i}.png" for i in range(len(EYES))])
    poses = []
    for i in range(len(EYES)):
        rotation, eye = world_from_cam(i)
        poses.append([*Rotation.from_matrix(rotation @ OPENGL).as_quat(), *eye])  # x y z w
        write_depth(folder / "depth" / f"{i}.png")
    matrix = np.array([[FOCAL, 0, 83.0], [0, FOCAL + 2, 57.0], [0, 0, 1]])
    contents = {"w": WIDTH, "h": HEIGHT, "fps": 30, "K": matrix.T.ravel().tolist(), "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(contents))
    return pinhole


def bundler(folder, names=NAMES):
    def project(i, point):
        rotation, eye = world_from_cam(i)
        p = (rotation @ OPENGL).T @ (point - eye)  # P = R X + t
        x, y = -p[:2] / p[2]
        r2 = x * x + y * y
        scale = FOCAL * (1 + K1 * r2 + K2 * r2**2)
        return WIDTH / 2 + scale * x, HEIGHT / 2 - scale * y  # y points up

    write_photos(folder / "images", project)
    lines = ["# Bundle file v0.3", f"{len(names) + 1} {len(POINTS)}"]
    for i in range(len(names)):
        rotation, eye = world_from_cam(i)
        matrix = (rotation @ OPENGL).T
        rows = [[FOCAL, K1, K2], *matrix, -matrix @ eye]
        lines += [" ".join(repr(float(number)) for number in row) for row in rows]
    lines += ["0 0 0"] * 5  # a photo that is not registered
    for point in POINTS:
        lines += [" ".join(map(repr, point.tolist())), "10 20 30", "2 0 5 1.5 -2.5 1 6 0.5 0.25"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    listed = [f"./images/{names[0]} 0 130.5", *(f"images/{name}" for name in names[1:]), "images/lost.png"]
    (folder / "list.txt").write_text("\n".join(listed) + "\n")
    return project


def nvm(folder, names=NAMES, r=0.1):
    """The distortion leads from the photo to the pinhole: u = d (1 + r d^2)."""

    def project(i, point):
        x, y, z = in_camera(i, point)
        straight = np.hypot(x, y) / z
        bent = brentq(lambda d: d * (1 + r * d * d) - straight, 0, 2 * straight)
        return np.array([WIDTH, HEIGHT]) / 2 + FOCAL * bent / straight * np.array([x, y]) / z

    write_photos(folder / "images", project)
    lines = ["NVM_V3 ", "", f"{len(names)}"]
    for i, name in enumerate(names):
        rotation, eye = world_from_cam(i)
        w, x, y, z = np.roll(Rotation.from_matrix(rotation.T).as_quat(), 1)
        numbers = " ".join(repr(float(number)) for number in [FOCAL, w, x, y, z, *eye, r])
        lines.append("images/" + name.replace(" ", '"') + f"\t{numbers} 0 ")
    lines += ["", f"{len(POINTS)}"]
    lines += [" ".join(map(repr, p.tolist())) + " 10 20 30 2 0 5 1.5 -2.5 1 6 0.5 0.25 " for p in POINTS]
    (folder / "model.nvm").write_text("\n".join([*lines, "", "0", ""]))
    return project


def opensfm(folder, kind="brown", names=NAMES):
    """OpenDroneMap's folders: the reconstruction is in opensfm/, beside images/."""
    camera = {"projection_type": kind, "width": WIDTH, "height": HEIGHT, "k1": K1, "k2": K2}
    if kind == "brown":
        camera |= {"focal_x": 0.8, "focal_y": 0.82, "c_x": 0.02, "c_y": -0.01, "k3": 0.01, "p1": 0.003}
        camera["p2"] = -0.002
    else:
        camera["focal"] = 0.8

    def project(i, point):
        x, y = before_distortion(i, point, kind)
        r2 = x * x + y * y
        radial = 1 + K1 * r2 + K2 * r2**2 + camera.get("k3", 0) * r2**3
        p1, p2 = camera.get("p1", 0), camera.get("p2", 0)
        u = camera.get("focal_x", 0.8) * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
        v = camera.get("focal_y", 0.8) * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))
        u, v = u + camera.get("c_x", 0), v + camera.get("c_y", 0)
        return max(SIZE) * u + WIDTH / 2, max(SIZE) * v + HEIGHT / 2

    write_photos(folder / "images", project)
    shots = {}
    for i, name in enumerate(names):
        rotation, eye = world_from_cam(i)
        turn = Rotation.from_matrix(rotation.T).as_rotvec()
        shots[name] = {
            "rotation": turn.tolist(),
            "translation": (-rotation.T @ eye).tolist(),
            "camera": "c 1",
        }
    points = {str(i): {"coordinates": p.tolist(), "color": [10, 20, 30]} for i, p in enumerate(POINTS)}
    largest = {"cameras": {"c 1": camera}, "shots": shots, "points": points}
    (folder / "opensfm").mkdir()
    small = {"cameras": {}, "shots": {}, "points": {}}
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps([small, largest]))
    return project


def openmvg(folder, kind="pinhole_brown_t2", names=NAMES):
    k3, t1, t2 = 0.01, 0.003, -0.002
    brown = kind == "pinhole_brown_t2"

    def project(i, point):
        x, y, z = in_camera(i, point)
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + K1 * r2 + K2 * r2**2 + k3 * r2**3
        if brown:
            x, y = (
                x * radial + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y,
                y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y,
            )
        return FOCAL * x + 83.0, FOCAL * y + 57.0

    write_photos(folder / "images", project)
    views, extrinsics = [], []
    for i, name in enumerate([*names, "lost.png"]):
        data = {"local_path": "/", "filename": name, "width": WIDTH, "height": HEIGHT}
        data |= {"id_view": i, "id_intrinsic": i % 2, "id_pose": i}
        views.append({"key": i, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": i, "data": data}}})
    for i in range(len(names)):
        rotation, eye = world_from_cam(i)
        extrinsics.append({"key": i, "value": {"rotation": rotation.T.tolist(), "center": eye.tolist()}})
    data = {"width": WIDTH, "height": HEIGHT, "focal_length": FOCAL, "principal_point": [83.0, 57.0]}
    data |= {"disto_t2": [K1, K2, k3, t1, t2]} if brown else {}
    first = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": kind}
    intrinsics = [
        {"key": 0, "value": first | {"ptr_wrapper": {"id": 1, "data": data}}},
        {"key": 1, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": 2, "data": data}}},
    ]
    structure = [{"key": i, "value": {"X": p.tolist(), "observations": []}} for i, p in enumerate(POINTS)]
    contents = {"sfm_data_version": "0.3", "root_path": "/home/someone/images", "views": views}
    contents |= {"intrinsics": intrinsics, "extrinsics": extrinsics, "structure": structure}
    (folder / "sfm_data.json").write_text(json.dumps(contents | {"control_points": []}))
    return project


NAMED = {  # formats whose files name the photos, and the file
    metashape: "cameras.xml",
    realitycapture: "registration.csv",
    bundler: "list.txt",
    nvm: "model.nvm",
    opensfm: "opensfm/reconstruction.json",
    openmvg: "sfm_data.json",
}
FILES = {  # what a fuzzer damages
    **{writer: [file] for writer, file in NAMED.items()},
    bundler: ["bundle.out", "list.txt"],
    polycam: [
        "keyframes/corrected_cameras/123450.json",
        "keyframes/depth/123451.png",
        "keyframes/confidence/123450.png",
    ],
    record3d: ["metadata.json", "depth/0.png"],
}
