"""The architecture, read from the imports: they may only point to a lower layer."""

import ast
from pathlib import Path

import pytest

import splatax

ROOT = Path(splatax.__file__).parent
LAYERS = (  # lowest first; a package stands for all its modules
    {"ahead", "math", "errors", "packages", "shapes", "splits", "varying", "low_pass"},
    {"gaussians", "splats", "cameras", "dataset", "resampling", "scene", "transforms", "moving"},
    {"footprints", "projection", "along_rays", "surfaces", "sky", "losses", "metrics", "lpips", "io"},
    {"backends"},
    {"drawn", "surface_outputs", "outputs", "pipeline", "stages", "rendering", "trajectories"},
    {"training", "evaluation", "adjustment", "geometry_scores", "editing", "sensors"},
    {"demo", "bench", "reconstruction", "mesh", "notebook", "twins", "web"},
    {"runs"},
    {"inspection", "blocks"},
    {"report"},
    {"viewer"},
    {"cli", "__main__"},
)
NEVER = {
    ("training", "io"),
    ("io", "backends"),
    ("io", "projection"),
    ("editing", "io"),
}  # in reach, but not theirs
# Modules that look a backend up, beside the commands: entry points, and what starts a run. All others get its kernels.
LOOK_UP = {
    "bench/operations",
    "blocks/visibility",
    "inspection/pace",
    "rendering",
    "stages",
    "training/loop",
    "training/rigged",
}
OPTIONAL = {"beartype", "hypothesis", "playwright", "pytest"}  # not installed with the product


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts != ("__init__",):  # the public names, which gather from everywhere
            yield path, parts[0]


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "splatax":
                yield from (f"splatax.{alias.name}" for alias in node.names)
            else:
                yield node.module or ""


def layer_of(package):
    layers = [i for i, names in enumerate(LAYERS) if package in names]
    assert layers, f"{package} is in no layer: add it to LAYERS"
    return layers[0]


@pytest.mark.parametrize(
    ("path", "package"), [pytest.param(*m, id=str(m[0].relative_to(ROOT))) for m in modules()]
)
def test_imports_point_down(path, package):
    for name in imports(path):
        top, *rest = name.split(".")
        assert top not in OPTIONAL, f"{path.name} imports {name}, which only tests may"
        if top == "splatax" and rest and rest[0] != package:
            assert layer_of(rest[0]) <= layer_of(package), f"{package} imports {name}, which lies above it"
            assert (package, rest[0]) not in NEVER, f"{package} must not know {rest[0]}"


def test_a_backend_is_looked_up_by_entry_points_alone():
    """What they trace, such as `pipeline` and the steps of training, is given kernels."""
    found = {
        str(path.relative_to(ROOT).with_suffix(""))
        for path, package in modules()
        if package not in ("backends", "cli") and "splatax.backends" in imports(path)
    }
    assert found == LOOK_UP


def test_files_stay_small_enough_to_read():
    long = {str(p.relative_to(ROOT)): n for p, _ in modules() if (n := len(p.read_text().splitlines())) > 300}
    assert not long
