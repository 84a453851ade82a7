"""Scores a saved scene independently: renders it from the held-out cameras without any code of splatax.

    python docs/judge.py CAPTURE SCENE.ply

The renderer is NumPy, one Gaussian after the other in float64, directly from the formulas of Kerbl et al.
2023 and Zwicker et al. 2001. It needs pycolmap and Pillow, and a COLMAP capture with pinhole cameras and
photos of the cameras' size. Every 8th photo by name is held out; the background is black.
"""

import sys
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image


def read(path):
    """Reads the columns of a binary PLY file of floats, by name."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in head.decode().splitlines()]
    names = [words[2] for words in lines if words[0] == "property"]
    assert all(words[1] == "float" for words in lines if words[0] == "property")
    table = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(np.float64)
    return dict(zip(names, table.T, strict=True))


def harmonics(d):
    """Returns the 16 real spherical harmonics up to degree 3 at unit directions d (n, 3).

    The signs include the Condon-Shortley phase.
    """
    x, y, z = d.T
    pi = np.pi
    a, b, c = np.sqrt(3 / (4 * pi)), np.sqrt(15 / (4 * pi)), np.sqrt(5 / (16 * pi))
    e, f = np.sqrt(35 / (32 * pi)), np.sqrt(21 / (32 * pi))
    return np.stack([
        np.full_like(x, np.sqrt(1 / (4 * pi))),
        -a * y, a * z, -a * x,
        b * x * y, -b * y * z, c * (3 * z * z - 1), -b * x * z, b / 2 * (x * x - y * y),
        -e * y * (3 * x * x - y * y), np.sqrt(105 / (4 * pi)) * x * y * z, -f * y * (5 * z * z - 1),
        np.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3), -f * x * (5 * z * z - 1),
        np.sqrt(105 / (16 * pi)) * z * (x * x - y * y), -e * x * (x * x - 3 * y * y),
    ], axis=1)  # fmt: skip


def rotations(q):
    """Returns the rotation matrices (n, 3, 3) of quaternions (n, 4), wxyz."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], axis=1).reshape(-1, 3, 3)  # fmt: skip


def project(scene, pose, k, width, height):
    """Projects a scene to means (n, 2), covariances (n, 2, 2), depths, opacities (n,) and colours (n, 3)."""

    def columns(*names):
        return np.stack([scene[name] for name in names], axis=1)

    means = columns("x", "y", "z")
    local = means @ pose[:, :3].T + pose[:, 3]
    center = -pose[:, :3].T @ pose[:, 3]
    away = means - center
    basis = harmonics(away / np.linalg.norm(away, axis=1, keepdims=True))
    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15)
    dc = columns("f_dc_0", "f_dc_1", "f_dc_2")[..., None]
    colors = np.maximum(np.einsum("nck,nk->nc", np.concatenate([dc, rest], axis=2), basis) + 0.5, 0)
    opacities = 1 / (1 + np.exp(-scene["opacity"]))
    axes = rotations(columns("rot_0", "rot_1", "rot_2", "rot_3"))
    axes = axes * np.exp(columns("scale_0", "scale_1", "scale_2"))[:, None, :]
    axes = np.einsum("ij,njk->nik", pose[:, :3], axes)
    x, y, z = local.T
    fx, fy = k[0, 0], k[1, 1]
    # The slopes at which the Jacobian is taken are kept near the image, as in the authors' code.
    limit = 1.3 * np.array([width / (2 * fx), height / (2 * fy)])
    sx, sy = np.clip(x / z, -limit[0], limit[0]), np.clip(y / z, -limit[1], limit[1])
    zero = np.zeros_like(z)
    jacobian = np.stack([fx / z, zero, -fx * sx / z, zero, fy / z, -fy * sy / z], axis=1).reshape(-1, 2, 3)
    flat = jacobian @ axes
    covariances = flat @ flat.transpose(0, 2, 1) + 0.3 * np.eye(2)
    means2d = np.stack([fx * x / z + k[0, 2], fy * y / z + k[1, 2]], axis=1)
    return means2d, covariances, z, opacities, colors


def draw(means, covariances, depths, opacities, colors, size):
    """Draws splats as an image (height, width, 3) over black."""
    width, height = size
    image, left = np.zeros((height, width, 3)), np.ones((height, width))
    u, v = means.T
    for i in np.argsort(depths, kind="stable"):
        if depths[i] < 0.01 or opacities[i] < 1 / 255:
            continue
        reach = np.sqrt(2 * np.log(255 * opacities[i]) * np.diag(covariances[i]))
        x0, x1 = max(int(u[i] - reach[0]), 0), min(int(u[i] + reach[0]) + 2, width)
        y0, y1 = max(int(v[i] - reach[1]), 0), min(int(v[i] + reach[1]) + 2, height)
        if x0 >= x1 or y0 >= y1:
            continue
        inverse = np.linalg.inv(covariances[i])
        dx, dy = np.arange(x0, x1) + 0.5 - u[i], (np.arange(y0, y1) + 0.5 - v[i])[:, None]
        power = inverse[0, 0] * dx * dx + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy * dy
        alpha = np.minimum(opacities[i] * np.exp(-power / 2), 0.99)
        part = left[y0:y1, x0:x1]
        alpha[(alpha < 1 / 255) | (part < 1e-4)] = 0
        image[y0:y1, x0:x1] += (alpha * part)[..., None] * colors[i]
        part *= 1 - alpha
    return image


def main(capture, path):
    model, scene = pycolmap.Reconstruction(capture / "sparse" / "0"), read(path)
    scores = []
    for image in sorted(model.images.values(), key=lambda image: image.name)[::8]:
        camera = model.cameras[image.camera_id]
        assert camera.model.name in ("PINHOLE", "SIMPLE_PINHOLE"), "undistort the photos first"
        photo = np.asarray(Image.open(capture / "images" / image.name).convert("RGB"), np.float64)
        pose = image.cam_from_world()
        size = camera.width, camera.height
        splats = project(scene, pose.matrix(), camera.calibration_matrix(), *size)
        drawn = np.round(draw(*splats, size).clip(0, 1) * 255)
        scores.append(20 * np.log10(255 / np.sqrt(np.mean((drawn - photo) ** 2))))
        print(f"{image.name}  {scores[-1]:.2f} dB", flush=True)
    print(f"mean  {np.mean(scores):.2f} dB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
