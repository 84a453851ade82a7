"""The emulation and the sanitizers find no errors in the kernels, and find those that are inserted here.

The kernels run without JAX, in a program that gives each array memory of its own:
`native/emulation/standalone.cc`.
"""

import os
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import pytest

import emulated

SANITIZED = ("-O0", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
PLAIN = ("-O1",)  # runs many times as fast, and enough where the printed results tell
HOST = [
    emulated.NATIVE / "cuda" / "host" / f"{name}.cc"
    for name in ["driver", "work", "profile", "sorting", "rasterize"]
]
KERNELS, EMULATION = emulated.NATIVE / "cuda" / "kernels", emulated.NATIVE / "emulation"
ORDERS = (0, 1)  # in which threads take turns

# mistake: file, what stands there, what is planted, and what is seen: the program stops with this message, or
# prints other results
MISTAKES = {
    "no barrier after loading": (
        "blending.cuh",
        "    }\n    __syncthreads();\n    for (int k = 0; k < count &&",
        "    }\n    for (int k = 0; k < count &&",
        None,
    ),
    "no barrier before adding partial sums": (
        "gradient.cuh",
        "    __syncthreads();\n    for (int k = threadIdx.x; k < count",
        "    for (int k = threadIdx.x; k < count",
        None,
    ),
    "no barrier between lanes": (
        "sorting.cuh",
        "__popc(same & ((1u << lane) - 1));\n    __syncwarp();",
        "__popc(same & ((1u << lane) - 1));",
        None,
    ),
    "a race of warps": (
        "gradient.cuh",
        "partial[warp][i][own_value] =",
        "partial[warp / 2][i][own_value] =",
        None,
    ),
    "beyond shared memory": (
        "gradient.cuh",
        "found[WARPS][SLICE / WARP_SIZE]",
        "found[WARPS - 1][SLICE / WARP_SIZE]",
        "out of bounds",
    ),
    "beyond an array": ("binning.cuh", "if (i > n) return;", "", "heap-buffer-overflow"),
    "a vote of some lanes": (
        "blending.cuh",
        "k < count && __any_sync(ALL_LANES, alive)",
        "k < count && alive",
        "deadlock",
    ),
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(emulated.why_unavailable() is not None, reason=str(emulated.why_unavailable())),
]


Host = Callable[[tuple[str, ...]], list[Path]]


@pytest.fixture(scope="module")
def host(tmp_path_factory) -> Host:
    """The host side and the program, compiled once with each options: mistakes are planted in the kernels."""

    @cache
    def compiled(options: tuple[str, ...]) -> list[Path]:
        folder = tmp_path_factory.mktemp("host")
        sources = [*HOST, EMULATION / "standalone.cc"]
        objects = [folder / f"{source.stem}.o" for source in sources]
        with ThreadPoolExecutor(os.cpu_count()) as executor:
            list(executor.map(lambda s, o: emulated.compile([s], o, "-c", *options), sources, objects))
        return objects

    return compiled


def program(host: Host, options: tuple[str, ...], folder: Path, kernels: Path = KERNELS) -> Path:
    driver, linked = folder / "driver.o", folder / "standalone"
    emulated.compile([EMULATION / "driver.cc"], driver, "-c", *options, kernels=kernels)
    command = [
        emulated.COMPILER,
        *options,
        "-rdynamic",
        *host(options),
        driver,
        "-ldl",
        "-o",
        linked,
    ]
    subprocess.run([str(part) for part in command], check=True)
    return linked


def runs(linked: Path, *arguments: str) -> list[subprocess.CompletedProcess]:
    """What the program does in each order."""

    def run(order):
        environment = {**os.environ, "SPLATAX_EMULATION_SEED": str(order)}
        return subprocess.run(
            [linked, *arguments], env=environment, capture_output=True, text=True, timeout=600, check=False
        )

    with ThreadPoolExecutor(len(ORDERS)) as executor:
        return list(executor.map(run, ORDERS))


def test_the_kernels_pass_the_sanitizers_and_print_the_same_bits_in_any_order(host, tmp_path):
    first, second = runs(program(host, SANITIZED, tmp_path))
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert first.stdout.count("\n") == 2 * 7 + 8 + 2 + 5
    assert first.stdout == second.stdout


@pytest.fixture(scope="module")
def expected(host, tmp_path_factory) -> str:
    first, second = runs(program(host, PLAIN, tmp_path_factory.mktemp("sound")), "rasterizer")
    assert first.stdout == second.stdout
    return first.stdout


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_planted_mistake_is_found(mistake, host, expected, tmp_path):
    name, right, wrong, message = MISTAKES[mistake]
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    for path in KERNELS.iterdir():
        text = path.read_text()
        if path.name == name:
            assert text.count(right) == 1, f"{name} has changed: plant the mistake anew"
            text = text.replace(right, wrong)
        (kernels / path.name).write_text(text)
    options = PLAIN if message is None else SANITIZED
    done = runs(program(host, options, tmp_path, kernels), "rasterizer")
    if message is None:
        assert any(run.returncode or run.stdout != expected for run in done)
    else:
        assert all(run.returncode and message in run.stderr for run in done), done[0].stderr
