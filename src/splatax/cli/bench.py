"""`splatax bench`: what rendering and training cost on this machine."""

import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import splatax as sx
from splatax.bench.operations import of_backend, shared
from splatax.bench.scenes import Scene, procedural, whole
from splatax.bench.timing import Timing, interleaved
from splatax.cli.options import BackendName, resolve_backend
from splatax.cli.platform import device, peak_memory, versions
from splatax.cli.results import write_json
from splatax.errors import InputError

BIKER = "biker"  # a trained scene among the project's test data; timed where it is found


@dataclass(frozen=True)
class Bench:
    """Time projection, rasterizer, loss, Adam and the whole training step.

    All operations are timed in turn, round after round, in one process. Prints a table of medians
    and minima, and writes bench.json.
    """

    out: Path = Path("runs/bench")
    """Folder for bench.json. An earlier one is replaced."""
    scenes: tuple[str, ...] = ("10k", "50k", "150k", BIKER)
    """Counts of Gaussians for a procedural scene (10k, 1M), splat files, or "biker", which is found
    in $SPLATAX_DATA/splats."""
    sizes: tuple[str, ...] = ("504x378",)
    """Of images, WIDTHxHEIGHT in pixels."""
    backends: tuple[BackendName, ...] = ("auto",)
    """Rasterizers to compare."""
    rounds: int = 7
    """How often each operation is timed."""

    def run(self) -> None:
        if self.rounds < 1:
            raise InputError(f"--rounds: at least 1, not {self.rounds}.")
        sizes = [parse_size(size) for size in self.sizes]
        backends = list(dict.fromkeys(resolve_backend(name) for name in self.backends))
        makers = [maker for name in self.scenes if (maker := scene_maker(name))]
        self.out.mkdir(parents=True, exist_ok=True)
        console = Console()
        results = []
        for make in makers:
            for size in sizes:
                results.append(measure(make(size), backends, self.rounds, console))
                console.print(table(results[-1]))
                write_json(self.out / "bench.json", self.contents(results))
        print(f"timings {self.out / 'bench.json'}")

    def contents(self, results: list[dict[str, Any]]) -> dict[str, Any]:
        """Of bench.json."""
        return {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "device": device(),
            "versions": versions(),
            "protocol": f"{self.rounds} rounds over all operations in turn, milliseconds of wall time",
            "results": results,
        }


def measure(scene: Scene, backends: list[str], rounds: int, console: Console) -> dict[str, Any]:
    """Times one scene at one size."""
    operations = {("", name): operation for name, operation in shared(scene).items()}
    for backend in backends:
        operations |= {(backend, name): operation for name, operation in of_backend(scene, backend).items()}
    labels = {f"{name} {backend}".strip(): (backend, name) for backend, name in operations}
    with console.status(f"{scene.name}: compiling") as status:
        timings: dict[str, Timing] = {}
        by_label = {label: operations[key] for label, key in labels.items()}
        for done, timings in enumerate(interleaved(by_label, rounds), start=1):
            status.update(f"{scene.name}: round {done} of {rounds}")
    visible = int((sx.project(scene.gaussians, scene.camera).extents[:, 0] > 0).sum())
    return {
        "scene": scene.name,
        "gaussians": len(scene.gaussians),
        "sh_degree": scene.gaussians.sh_degree,
        "visible": visible,
        "width": scene.camera.width,
        "height": scene.camera.height,
        "operations": [
            {"operation": labels[label][1], "backend": labels[label][0] or None, **asdict(timing)}
            for label, timing in timings.items()
        ],
        "peak_rss_bytes": peak_memory(),
    }


def table(result: dict[str, Any]) -> Table:
    """What people read."""
    used = result["peak_rss_bytes"]
    memory = f", peak memory {used / 1e9:.2f} GB" if used else ""
    title = (
        f"{result['scene']}: {result['visible']:,} of {result['gaussians']:,} Gaussians visible, "
        f"SH degree {result['sh_degree']}, {result['width']} x {result['height']}{memory}"
    )
    drawn = Table(title=title, title_justify="left")
    for heading in ("operation", "backend"):
        drawn.add_column(heading)
    for heading in ("median, ms", "minimum, ms", "first call, ms"):
        drawn.add_column(heading, justify="right")
    for row in result["operations"]:
        times = [f"{row[key]:.1f}" for key in ("median", "minimum", "first")]
        drawn.add_row(row["operation"], row["backend"] or "", *times)
    return drawn


def scene_maker(name: str) -> Callable[[tuple[int, int]], Scene] | None:
    """What makes a scene for an image size; None, after a line that says so, for absent test data.

    Raises:
        InputError: if there is no such scene.
    """
    count = re.fullmatch(r"([1-9]\d*)([kM]?)", name)
    if count:
        return partial(procedural, int(count[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[count[2]])
    path = Path(name)
    if name == BIKER:
        path = Path(os.environ.get("SPLATAX_DATA", "../shared/data")) / "splats" / "biker.compressed.ply"
        if not path.exists():
            print(f"biker: skipped, no {path}. SPLATAX_DATA names the folder of test data.")
            return None
    if not path.exists():
        raise InputError(f"--scenes {name}: neither a count such as 50k, nor a splat file, nor {BIKER!r}.")
    return partial(whole, name, sx.load(path))


def parse_size(size: str) -> tuple[int, int]:
    """Width and height from "504x378".

    Raises:
        InputError: if it is something else.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", size)
    if not match:
        raise InputError(f"--sizes: WIDTHxHEIGHT in pixels such as 504x378, not {size!r}.")
    return int(match[1]), int(match[2])
