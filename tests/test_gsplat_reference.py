"""Projection and spherical harmonics agree with gsplat's own reference functions, values and gradients.

gsplat (Apache-2.0) states what its kernels compute as functions of plain PyTorch. They are read from the
installed package, without importing it, so that nothing is compiled and no GPU is needed:

    pip install -e '.[gsplat,test]'
    pytest tests/test_gsplat_reference.py

The released package has no such function for the unscented transform. Its seven points are projected here by
gsplat's camera functions, and their moments are taken by NumPy.
"""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.cameras import to_opencv
from splatax.cameras.lenses import Fisheye, Orthographic
from splatax.footprints import Unscented
from splatax.low_pass import Antialiasing, Dilation
from splatax.math import harmonics

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[gsplat]'")

SIZE = (64, 48)
ROUNDING = 1e-9  # of sums of products of float64 with values up to 1e3
EPS = 1e-5  # gsplat's fisheye adds 1e-7 to lengths and squares, which are 0.1 to 1 here


@pytest.fixture(scope="module")
def reference():
    """gsplat's module of reference functions."""
    package = importlib.util.find_spec("gsplat")
    if package is None or not package.submodule_search_locations:
        pytest.skip("gsplat is not installed: pip install '.[gsplat]'")
    path = Path(package.submodule_search_locations[0]) / "cuda" / "_torch_impl.py"
    if not path.is_file():
        pytest.skip(f"this version of gsplat has no {path.name}: install gsplat 1.5")
    spec = importlib.util.spec_from_file_location("gsplat_torch_impl", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def scene_and_camera(lens=None):
    """Gaussians of which some lie beside the image, where the tangent of the lens is taken at its margin."""
    scene = random_gaussians(n=200, degree=0, spread=2.0, scale=(0.02, 0.4), dtype=np.float64)
    camera = camera_at((0.3, 0.5, -3.0), size=SIZE, focal=40.0, dtype=np.float64)
    return scene, camera if lens is None else sx.cameras.from_opencv(*to_opencv(camera)[:2], *SIZE, lens)


def tensor(array):
    return torch.tensor(np.asarray(array, np.float64), requires_grad=True)


def theirs(reference, scene, camera, model):
    """The inputs and the outputs of gsplat's projection, without the axes of batches."""
    K, pose = to_opencv(camera)[:2]
    inputs = {
        "means": tensor(scene.means),
        "quats": tensor(scene.quats),
        "scales": tensor(np.exp(scene.log_scales)),
        "viewmat": tensor(pose),
        "K": tensor(K),
    }
    covars, _ = reference._quat_scale_to_covar_preci(inputs["quats"], inputs["scales"], True, False, False)
    radii, means2d, depths, conics, fades = reference._fully_fused_projection(
        inputs["means"],
        covars,
        inputs["viewmat"][None],
        inputs["K"][None],
        *SIZE,
        eps2d=0.3,
        calc_compensations=True,
        camera_model=model,
    )
    return inputs, radii[0], torch.cat([means2d[0], depths[0][:, None], conics[0], fades[0][:, None]], dim=1)


def ours(scene, camera, projection=None):
    """The same seven numbers of each Gaussian, and which are drawn."""
    method = {} if projection is None else {"projection": projection}
    splats = sx.project(scene, camera, low_pass=Antialiasing(0.3, floor=0.0), backend="xla", **method)
    u, v, w = splats.sqrt_conics.T
    fades = splats.opacities / scene.opacities
    columns = [splats.depths, u * u, u * v, v * v + w * w, fades]
    return jnp.concatenate([splats.means2d, jnp.stack(columns, axis=1)], axis=1), splats


@pytest.mark.parametrize(
    ("model", "lens", "tolerance"),
    [("pinhole", None, ROUNDING), ("ortho", Orthographic(), ROUNDING), ("fisheye", "fisheye", EPS)],
)
def test_projection_and_its_gradients(x64, reference, model, lens, tolerance):
    if lens == "fisheye":
        lens = Fisheye(jnp.zeros(4))
    scene, camera = scene_and_camera(lens)
    inputs, radii, expected = theirs(reference, scene, camera, model)
    found, splats = ours(scene, camera)
    both = np.asarray(splats.extents[:, 0] > 0) & (radii.detach().numpy() > 0).all(axis=1)
    assert both.sum() > 20
    if model == "fisheye":  # off its axis
        local = np.asarray(scene.means @ camera.rotation.T + camera.translation[None])
        both &= np.linalg.norm(local[:, :2], axis=1) > 0.1
    same = np.arange(7) != (2 if model == "fisheye" else -1)  # its depth is z there, the distance here
    assert_allclose(
        found[both][:, same], expected.detach().numpy()[both][:, same], rtol=tolerance, atol=tolerance
    )

    weights = np.random.default_rng(0).normal(size=expected.shape) * both[:, None] * same[None]
    (expected * torch.tensor(weights)).sum().backward()

    def loss(scene, camera):
        return jnp.sum(ours(scene, camera)[0] * weights)

    d_scene, d_camera = jax.grad(loss, (0, 1))(scene, camera)
    d_scales = np.asarray(d_scene.log_scales) / np.exp(scene.log_scales)
    slopes = {
        "means": (d_scene.means, inputs["means"].grad),
        "quats": (d_scene.quats, inputs["quats"].grad),
        "scales": (d_scales, inputs["scales"].grad),
        "pose": (d_camera.cam_from_world[:3], inputs["viewmat"].grad[:3]),
        "fx, fy": (d_camera.focal, torch.diagonal(inputs["K"].grad)[:2]),
        "cx, cy": (d_camera.center, inputs["K"].grad[:2, 2]),
    }
    for name, (one, other) in slopes.items():
        other = other.numpy()
        error = np.abs(np.asarray(one) - other).max() / max(np.abs(other).max(), 1e-12)
        print(f"{model:8} {name:7} {error:.1e}")
        assert error < 10 * tolerance, name


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics_and_their_gradients(x64, reference, degree):
    rng = np.random.default_rng(degree)
    directions, coefficients = rng.normal(size=(50, 3)), rng.normal(size=(50, harmonics.count(degree), 3))
    there = [tensor(directions), tensor(coefficients)]
    expected = reference._spherical_harmonics(degree, *there)
    weights = rng.normal(size=(50, 3))

    def evaluated(directions, coefficients):
        unit = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
        return jax.vmap(harmonics.evaluate)(coefficients, unit)

    here = jnp.asarray(directions), jnp.asarray(coefficients)
    assert_allclose(evaluated(*here), expected.detach().numpy(), atol=ROUNDING)
    (expected * torch.tensor(weights)).sum().backward()
    slopes = jax.grad(lambda *inputs: jnp.sum(evaluated(*inputs) * weights), (0, 1))(*here)
    for one, other in zip(slopes, there, strict=True):
        given = np.zeros_like(one) if other.grad is None else other.grad.numpy()
        assert_allclose(one, given, atol=ROUNDING)


@pytest.mark.parametrize(("model", "tolerance"), [("pinhole", ROUNDING), ("fisheye", EPS)])
def test_the_unscented_transform_of_points_that_gsplat_projects(x64, reference, model, tolerance):
    scene, camera = scene_and_camera(Fisheye(jnp.zeros(4)) if model == "fisheye" else None)
    method = Unscented(alpha=0.8, beta=2.0, kappa=0.5)
    found, splats = ours(scene, camera, method)
    shown = np.asarray(splats.extents[:, 0] > 0)
    assert shown.sum() > 20

    K, pose = (torch.tensor(np.asarray(part, np.float64)) for part in to_opencv(camera)[:2])
    covars, _ = reference._quat_scale_to_covar_preci(
        tensor(scene.quats), tensor(np.exp(scene.log_scales)), True, False, False
    )
    # Any root of the covariance with the axes of the ellipsoid as columns has the same seven points.
    root = reference._quat_scale_to_matrix(tensor(scene.quats), tensor(np.exp(scene.log_scales)))
    assert torch.allclose(root @ root.transpose(1, 2), covars)
    squared = method.alpha**2 * (3 + method.kappa)
    offsets = squared**0.5 * torch.cat([torch.zeros_like(root[:, :1]), root.mT, -root.mT], dim=1)
    points = torch.tensor(np.asarray(scene.means))[:, None] + offsets
    local, none = reference._world_to_cam(
        points.reshape(-1, 3), torch.zeros(7 * len(scene), 3, 3, dtype=torch.float64), pose[None]
    )
    camera_of = {"pinhole": reference._persp_proj, "fisheye": reference._fisheye_proj}[model]
    pixels = camera_of(local, none, K[None], *SIZE)[0].detach().numpy().reshape(-1, 7, 2)

    spread = squared - 3
    for_mean = np.array([spread / squared] + [0.5 / squared] * 6)
    for_covariance = for_mean + np.array([1 - method.alpha**2 + method.beta] + [0.0] * 6)
    mean = np.einsum("k,nkx->nx", for_mean, pixels)
    apart = pixels - mean[:, None]
    covariance = np.einsum("k,nkx,nky->nxy", for_covariance, apart, apart) + Dilation().variance * np.eye(2)
    conics = np.linalg.inv(covariance)
    assert_allclose(found[shown, :2], mean[shown], rtol=tolerance, atol=tolerance)
    expected = np.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], axis=1)
    assert_allclose(found[shown, 3:6], expected[shown], rtol=10 * tolerance, atol=tolerance)
