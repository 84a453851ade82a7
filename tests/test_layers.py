"""The architecture, read from the imports: they may only point to a lower layer."""

import ast
import re
from pathlib import Path

import pytest

import splatax

ROOT = Path(splatax.__file__).parent
LAYERS = (  # lowest first; a package stands for all its modules
    {
        "ahead",
        "digests",
        "math",
        "errors",
        "packages",
        "pytrees",
        "shapes",
        "splits",
        "varying",
        "low_pass",
        "order",
    },
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
# Modules that look a backend up, beside the commands: entry points, and what starts a run.
LOOK_UP = {
    "bench/operations",
    "blocks/parts",
    "blocks/visibility",
    "rendering",
    "runs/budget",
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


def cycle_of(graph):
    """Some names of a graph that lead back to the first; None if none do."""
    open_, done = [], set()

    def visit(name):
        if name in open_:
            return [*open_[open_.index(name) :], name]
        if name in done:
            return None
        open_.append(name)
        found = next(filter(None, map(visit, sorted(graph.get(name, ())))), None)
        open_.pop()
        done.add(name)
        return found

    return next(filter(None, map(visit, sorted(graph))), None)


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: min(layer))
def test_packages_of_one_layer_do_not_import_each_other_in_a_circle(layer):
    graph = {package: set() for package in layer}
    for path, package in modules():
        if package in layer:
            parts = [name.split(".") for name in imports(path)]
            used = {part[1] for part in parts if part[0] == "splatax" and len(part) > 1}
            graph[package] |= (used & layer) - {package}
    assert cycle_of(graph) is None


def test_a_circle_is_found():
    assert cycle_of({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}) is None
    assert cycle_of({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]


def test_a_background_is_annotated_by_one_alias():
    """`Color` and `BackgroundLike` of `rendering` take tuples and arrays of NumPy and JAX."""
    own = {
        f"{path.relative_to(ROOT)}: {ast.unparse(node.annotation)}"
        for path, _ in modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, (ast.arg, ast.AnnAssign)) and node.annotation
        if (node.arg if isinstance(node, ast.arg) else ast.unparse(node.target)) == "background"
        if re.search(r"tuple\[|np\.ndarray", ast.unparse(node.annotation))
    }
    assert own == set()


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
