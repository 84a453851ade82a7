"""`splatax bench`: the time that rendering and training take on this machine."""

import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

import splatax as sx
from splatax.bench import roofline
from splatax.bench.operations import FEATURES, Operation, operations, widths_for
from splatax.bench.plot import plot
from splatax.bench.scenes import Scene, framed, procedural
from splatax.bench.timing import Timing, interleaved
from splatax.cli.options import BackendName, parse_size, resolve_backend
from splatax.cli.output import cell, say
from splatax.errors import InputError
from splatax.io.files import write_whole
from splatax.runs.machine import device, peak_memory, versions
from splatax.runs.records import write_json

BIKER = {"biker": 1.0, "biker-close": 3.0}  # a trained scene of the test data, from two distances


@dataclass(frozen=True)
class Bench:
    """Time projection, rasterizer, loss, Adam and the whole training step.

    All operations are timed in turn, round after round, in one process. Prints a table of medians
    and minima, and writes bench.json and bench.png. "of limit" is achieved arithmetic throughput as a
    fraction of the measured peak.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/bench")
    """Output folder for bench.json and bench.png. Existing files are replaced."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE [SCENE ...]")] = (
        "10k",
        "50k",
        "150k",
        *BIKER,
    )
    """Numbers of Gaussians for a procedural scene (10k, 1M), splat files, or "biker" and "biker-close",
    which are found in $SPLATAX_DATA/splats."""
    sizes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WIDTHxHEIGHT [WIDTHxHEIGHT ...]")] = ("504x378",)
    """Sizes of images in pixels."""
    backends: tuple[BackendName, ...] = ("auto",)
    """Backends to compare."""
    rounds: Annotated[int, tyro.conf.arg(metavar="N")] = 7
    """Number of times that each operation is timed."""

    def run(self) -> None:
        if self.rounds < 1:
            raise InputError(f"--rounds: at least 1, not {self.rounds}.")
        sizes = [parse_size("--sizes", size) for size in self.sizes]
        backends = list(dict.fromkeys(resolve_backend(name) for name in self.backends))
        makers = [maker for name in self.scenes if (maker := scene_maker(name))]
        self.out.mkdir(parents=True, exist_ok=True)
        console = Console()
        flops = roofline.peak_flops()
        if flops:
            console.print(f"multiply-adds: {flops / 1e9:.0f} GFLOP/s at most")
        for size in sizes:
            if too_many := [str(width) for width in FEATURES if width not in widths_for(size)]:
                say(
                    f"{size[0]} x {size[1]}: images of {', '.join(too_many)} features are too large for the "
                    "memory, and left out"
                )
        results = []
        for make in makers:
            for size in sizes:
                results.append(measure(make(size), backends, self.rounds, flops, console))
                console.print(table(results[-1]))
                write_json(self.out / "bench.json", self.contents(results, flops))
        write_whole(self.out / "bench.png", plot(results))
        say(f"timings {self.out / 'bench.json'}")
        say(f"plot    {self.out / 'bench.png'}")

    def contents(self, results: list[dict[str, Any]], flops: float | None) -> dict[str, Any]:
        """Returns the contents of bench.json."""
        return {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "device": device(),
            "peak_flops": flops,
            "versions": versions(),
            "protocol": f"{self.rounds} rounds over all operations in turn, milliseconds of wall time",
            "results": results,
        }


def measure(
    scene: Scene, backends: list[str], rounds: int, flops: float | None, console: Console
) -> dict[str, Any]:
    """Times one scene at one size, and compares the rasterizer with the machine's peak throughput."""
    by_key: dict[str, Operation] = {}
    for backend in backends:
        by_key |= {f"{name}|{backend}": operation for name, operation in operations(scene, backend).items()}
    timings: dict[str, Timing] = {}
    with console.status(f"{scene.name}: compiling") as status:
        for done, timings in enumerate(interleaved(by_key, rounds), start=1):
            status.update(f"{scene.name}: round {done} of {rounds}")
    splats = sx.project(scene.gaussians, scene.camera)
    counted = roofline.slots(splats)

    def fraction_of_limit(operation: str, milliseconds: float) -> float | None:
        shortest = roofline.shortest(operation, counted, flops) if counted and flops else None
        return shortest / milliseconds if shortest else None

    rows = []
    for key, timing in timings.items():
        name, backend = key.split("|")
        rows.append(
            {
                "operation": name,
                "backend": backend,
                **asdict(timing),
                "fraction_of_limit": fraction_of_limit(name, timing.median),
            }
        )
    return {
        "scene": scene.name,
        "procedural": scene.procedural,
        "gaussians": len(scene.gaussians),
        "sh_degree": scene.gaussians.sh_degree,
        "visible": int((splats.extents[:, 0] > 0).sum()),
        "slots": asdict(counted) if counted else None,
        "width": scene.camera.width,
        "height": scene.camera.height,
        "operations": rows,
        "peak_rss_bytes": peak_memory(),
    }


def table(result: dict[str, Any]) -> Table:
    """Returns a table of the timings of one scene."""
    used = result["peak_rss_bytes"]
    memory = f", peak memory {used / 1e9:.2f} GB" if used else ""
    title = (
        f"{result['scene']}: {result['visible']:,} of {result['gaussians']:,} Gaussians visible, "
        f"SH degree {result['sh_degree']}, {result['width']} x {result['height']}{memory}"
    )
    drawn = Table(title=cell(title), title_justify="left")
    for heading in ("operation", "backend"):
        drawn.add_column(heading)
    for heading in ("median, ms", "minimum, ms", "first, ms", "ratio", "of limit"):
        drawn.add_column(heading, justify="right")
    fastest: dict[str, float] = {}
    for row in result["operations"]:
        fastest[row["operation"]] = min(row["median"], fastest.get(row["operation"], row["median"]))
    for row in sorted(result["operations"], key=lambda row: list(fastest).index(row["operation"])):
        times = [f"{row[key]:.1f}" for key in ("median", "minimum", "first")]
        ratio = row["median"] / fastest[row["operation"]]
        limit = f"{row['fraction_of_limit']:.0%}" if row["fraction_of_limit"] else ""
        drawn.add_row(row["operation"], row["backend"], *times, f"{ratio:.2f}", limit)
    return drawn


def scene_maker(name: str) -> Callable[[tuple[int, int]], Scene] | None:
    """Returns a function that makes a scene for an image size; None, after a message, if test data is absent.

    Raises:
        InputError: if there is no such scene.
    """
    count = re.fullmatch(r"([1-9]\d*)([kM]?)", name)
    if count:
        return partial(procedural, int(count[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[count[2]])
    path = Path(name)
    if name in BIKER:
        path = Path(os.environ.get("SPLATAX_DATA", "../shared/data")) / "splats" / "biker.compressed.ply"
        if not path.exists():
            say(f"{name}: skipped, no {path}. SPLATAX_DATA names the folder of test data.")
            return None
    if not path.exists():
        raise InputError(
            f"--scenes {name}: neither a count such as 50k, nor a splat file, nor {' or '.join(BIKER)}."
        )
    return partial(framed, name, sx.load(path), BIKER.get(name, 1.0))
