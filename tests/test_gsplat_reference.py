"""Projection and spherical harmonics agree with gsplat's own reference functions, values and gradients.

gsplat (Apache-2.0) states what its kernels compute as functions of plain PyTorch. They are read from the
installed package, without importing it, so that nothing is compiled and no GPU is needed:

    pip install -e '.[gsplat,test]'
    pytest tests/test_gsplat_reference.py

The released package has no such function for the unscented transform. Its seven points are made of gsplat's
ellipsoids and projected by gsplat's camera functions here. Their moments are taken by PyTorch, which also
differentiates the whole.
"""

import ast
import importlib.util
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from gsplat_arguments import tabled_arguments
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
FISHEYE_EPS = "eps = 0.0000001"  # the line of gsplat's fisheye that does


@pytest.fixture(scope="module")
def installed():
    """The folder of the installed package."""
    package = importlib.util.find_spec("gsplat")
    if package is None or not package.submodule_search_locations:
        pytest.skip("gsplat is not installed: pip install '.[gsplat]'")
    return Path(package.submodule_search_locations[0])


@pytest.fixture(scope="module")
def source(installed):
    """The text of gsplat's module of reference functions."""
    path = installed / "cuda" / "_torch_impl.py"
    if not path.is_file():
        pytest.skip(f"this version of gsplat has no {path.name}: install gsplat 1.5")
    return path.read_text()


@pytest.fixture(scope="module")
def reference(source):
    """gsplat's reference functions as they are."""
    return module_of("gsplat_torch_impl", source)


@pytest.fixture(scope="module")
def exact(source):
    """gsplat's reference functions, whose fisheye adds nothing to lengths and squares."""
    assert source.count(FISHEYE_EPS) == 1
    return module_of("gsplat_torch_impl_exact", source.replace(FISHEYE_EPS, "eps = 0.0"))


def module_of(name, source):
    module = types.ModuleType(name)
    exec(source, module.__dict__)
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


CAMERAS = [("pinhole", "exact", ROUNDING), ("fisheye", "exact", ROUNDING), ("fisheye", "reference", EPS)]
LENSES = {"pinhole": lambda: None, "ortho": Orthographic, "fisheye": lambda: Fisheye(jnp.zeros(4))}


def agree_in_gradients(scene, camera, inputs, function, expected, weights, tolerance, name):
    """Compares the gradients of weighted sums of what gsplat and `function(scene, camera)` compute."""
    (expected * torch.tensor(weights)).sum().backward()
    d_scene, d_camera = jax.grad(lambda scene, camera: jnp.sum(function(scene, camera) * weights), (0, 1))(
        scene, camera
    )
    d_scales = np.asarray(d_scene.log_scales) / np.exp(scene.log_scales)
    slopes = {
        "means": (d_scene.means, inputs["means"].grad),
        "quats": (d_scene.quats, inputs["quats"].grad),
        "scales": (d_scales, inputs["scales"].grad),
        "pose": (d_camera.cam_from_world[:3], inputs["viewmat"].grad[:3]),
        "fx, fy": (d_camera.focal, torch.diagonal(inputs["K"].grad)[:2]),
        "cx, cy": (d_camera.center, inputs["K"].grad[:2, 2]),
    }
    for field, (one, other) in slopes.items():
        other = other.numpy()
        error = np.abs(np.asarray(one) - other).max() / max(np.abs(other).max(), 1e-12)
        print(f"{name:28} {field:7} {error:.1e}")
        assert error < 10 * tolerance, field


def off_axis(scene, camera):
    """Where a fisheye is not singular."""
    local = np.asarray(scene.means @ camera.rotation.T + camera.translation[None])
    return np.linalg.norm(local[:, :2], axis=1) > 0.1


@pytest.mark.parametrize(("model", "version", "tolerance"), [*CAMERAS, ("ortho", "exact", ROUNDING)])
def test_projection_and_its_gradients(x64, request, model, version, tolerance):
    scene, camera = scene_and_camera(LENSES[model]())
    inputs, radii, expected = theirs(request.getfixturevalue(version), scene, camera, model)
    found, splats = ours(scene, camera)
    both = np.asarray(splats.extents[:, 0] > 0) & (radii.detach().numpy() > 0).all(axis=1)
    if model == "fisheye":
        both &= off_axis(scene, camera)
    assert both.sum() > 20
    same = np.arange(7) != (2 if model == "fisheye" else -1)  # its depth is z there, the distance here
    one, other = found[both][:, same], expected.detach().numpy()[both][:, same]
    assert_allclose(one, other, rtol=tolerance, atol=tolerance)
    print(f"projection {model} {version}: values {np.abs(one - other).max():.1e}")

    weights = np.random.default_rng(0).normal(size=expected.shape) * both[:, None] * same[None]
    name = f"projection {model} {version}"
    agree_in_gradients(scene, camera, inputs, lambda *at: ours(*at)[0], expected, weights, tolerance, name)


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


def theirs_unscented(reference, scene, camera, model, method):
    """The inputs, means and conics of the seven points of gsplat's ellipsoids, which its cameras project."""
    K, pose = to_opencv(camera)[:2]
    fields = (scene.means, scene.quats, np.exp(scene.log_scales), pose, K)
    inputs = dict(zip(("means", "quats", "scales", "viewmat", "K"), map(tensor, fields), strict=True))
    # Any root of the covariance with the axes of the ellipsoid as columns has the same seven points.
    root = reference._quat_scale_to_matrix(inputs["quats"], inputs["scales"])
    squared = method.alpha**2 * (3 + method.kappa)
    offsets = squared**0.5 * torch.cat([torch.zeros_like(root[:, :1]), root.mT, -root.mT], dim=1)
    points = (inputs["means"][:, None] + offsets).reshape(-1, 3)
    none = torch.zeros(len(points), 3, 3, dtype=torch.float64)
    local, none = reference._world_to_cam(points, none, inputs["viewmat"][None])
    projected = {"pinhole": reference._persp_proj, "fisheye": reference._fisheye_proj}[model]
    pixels = projected(local, none, inputs["K"][None], *SIZE)[0].reshape(-1, 7, 2)

    spread = squared - 3
    for_mean = torch.tensor([spread / squared] + [0.5 / squared] * 6, dtype=torch.float64)
    for_covariance = for_mean.clone()
    for_covariance[0] += 1 - method.alpha**2 + method.beta
    mean = torch.einsum("k,nkx->nx", for_mean, pixels)
    apart = pixels - mean[:, None]
    covariance = torch.einsum("k,nkx,nky->nxy", for_covariance, apart, apart)
    conics = torch.linalg.inv(covariance + Dilation().variance * torch.eye(2, dtype=torch.float64))
    return inputs, torch.cat([mean, conics[:, 0], conics[:, 1, 1:]], dim=1)


@pytest.mark.parametrize(("model", "version", "tolerance"), CAMERAS)
def test_the_unscented_transform_and_its_gradients(x64, request, model, version, tolerance):
    scene, camera = scene_and_camera(LENSES[model]())
    method = Unscented(alpha=0.8, beta=2.0, kappa=0.5)

    def moments(scene, camera):
        return ours(scene, camera, method)[0][:, jnp.array([0, 1, 3, 4, 5])]

    shown = np.asarray(ours(scene, camera, method)[1].extents[:, 0] > 0)
    if model == "fisheye":
        shown = shown & off_axis(scene, camera)
    assert shown.sum() > 20
    inputs, expected = theirs_unscented(request.getfixturevalue(version), scene, camera, model, method)
    one, other = np.asarray(moments(scene, camera))[shown], expected.detach().numpy()[shown]
    assert_allclose(one, other, rtol=10 * tolerance, atol=tolerance)
    print(f"unscented {model} {version}: values {np.abs(one - other).max():.1e}")
    weights = np.random.default_rng(0).normal(size=expected.shape) * shown[:, None]
    name = f"unscented {model} {version}"
    agree_in_gradients(scene, camera, inputs, moments, expected, weights, tolerance, name)


def test_the_table_of_arguments_names_those_of_the_installed_version(installed):
    functions = ast.parse((installed / "rendering.py").read_text()).body
    (function,) = [node for node in functions if getattr(node, "name", None) == "rasterization"]
    arguments = {argument.arg for argument in function.args.args + function.args.kwonlyargs}
    assert len(arguments) >= 34
    assert arguments <= tabled_arguments()
