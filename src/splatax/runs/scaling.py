"""A model of what a training step costs on many devices: bytes counted, divided by rates of the hardware.

A step draws one view on each device. A device

    projects its rows for every view, and moves them once           memory traffic
    gets the splats that its view shows, and sends gradients back   traffic between devices
    draws its view, forward and backward                            time by pixel and by visible splat

Density control needs the old and the new rows of each device at a time. Test views and pictures are drawn by
the first device of a process, which gets the Gaussians of all for it.

Bytes are those of `splatax.training.travel`, which the tests count in the compiled program. The rates of
machines are assumptions, from data sheets and from published figures; nothing here was measured on them.
"""

import math
from dataclasses import dataclass

from splatax.training.travel import MOST, PIECES

FLOATS = 59  # of a Gaussian with harmonics of degree 3
ROW = 4 * FLOATS
STATE = 3 * ROW + 4 * 3  # of a row: parameters, two moments, three statistics of density control
ADAM = 7 * ROW  # a parameter and its two moments, read and written; its gradient, read
THERE = 4 * 12  # of a splat: mean 2, shape 3, depth 1, extent 2, colour 3, opacity 1
BACK = 4 * 12  # of its cotangent: mean 2, shape 3, depth 1, colour 3, opacity 1, pull 2
FLAG = 1  # of a row in one view: whether the view shows it
UNEVEN = 1.15  # time of the slowest view, as a multiple of the mean
LATENCIES = 4  # collective operations of a step that wait for each other, beside those for splats


@dataclass(frozen=True)
class Machine:
    """The rates of a kind of device.

    Attributes:
        name: of the device.
        memory: traffic of its memory, GB/s.
        inside: to other devices of its host, each way, GB/s.
        between: to other hosts, each way, GB/s.
        host: devices of one host.
        room: memory of the device, GB.
        latency: of a collective operation, ms.
        pixel: drawing one pixel, forward and backward, ns.
        splat: the same for one visible splat, ns.
    """

    name: str
    memory: float
    inside: float
    between: float
    host: int
    room: float
    latency: float
    pixel: float
    splat: float


MACHINES = {
    "H100": Machine("NVIDIA H100", 2700.0, 300.0, 40.0, 8, 80.0, 0.15, 1.0, 1.6),
    "A100": Machine("NVIDIA A100 80 GB", 1600.0, 200.0, 20.0, 8, 80.0, 0.2, 1.8, 2.9),
    "CPU": Machine("host with 16 CPU cores and 25 Gb/s", 80.0, 2.5, 2.5, 1, 64.0, 2.0, 28.0, 35.0),
}


@dataclass(frozen=True)
class Cost:
    """The cost of a step; times in ms.

    Attributes:
        rows: projecting and moving own rows.
        draw: drawing one view.
        travel: exchanging splats and gradients.
        wait: for collective operations to begin.
        exchanged: bytes that a device gets.
        memory: GB of a device during a step or during density control, whichever needs more.
        state: GB of the state of its rows.
        whole: GB that the first device of a process needs beside, to draw a view with all rows.
    """

    rows: float
    draw: float
    travel: float
    wait: float
    exchanged: int
    memory: float
    state: float
    whole: float

    @property
    def step(self) -> float:
        """Milliseconds of the step; nothing overlaps."""
        return self.rows + self.draw + self.travel + self.wait

    @property
    def peak(self) -> float:
        """GB of the device that needs most. Between steps, it keeps the state of its rows."""
        return max(self.memory, self.state + self.whole)


def cost(machine: Machine, devices: int, gaussians: int, pixels: int, seen: float) -> Cost:
    """Returns the cost of a step of as many views as devices.

    Args:
        machine: the kind of device.
        devices: their number.
        gaussians: of the scene.
        pixels: of a photo.
        seen: fraction of the Gaussians that a photo shows.
    """
    own = gaussians / devices
    projected = devices * own * (ROW + seen * 2 * ROW + THERE + BACK)
    visible = seen * gaussians
    draw = (pixels * machine.pixel + visible * machine.splat) * 1e-6 * (UNEVEN if devices > 1 else 1)
    exchanged = bytes_exchanged(gaussians, seen) if devices > 1 else 0
    splats = (devices * own + gaussians) * (THERE + BACK)  # of own rows in all views, and of all rows in one
    if devices > 1:
        splats += 2 * gaussians * THERE * MOST / PIECES  # of packed rows, there and here
        projected += 2 * gaussians * (THERE + BACK) * (1 + seen)  # packing and unpacking
    near = (min(devices, machine.host) - 1) / devices
    far = max(devices - machine.host, 0) / devices
    travel = max(exchanged * near / machine.inside, exchanged * far / machine.between) * 1e-6
    return Cost(
        rows=(projected + own * ADAM) / machine.memory * 1e-6,
        draw=draw,
        travel=travel,
        wait=(LATENCIES + 2 * exchanges(seen)) * machine.latency if devices > 1 else 0.0,
        exchanged=exchanged,
        memory=max(own * 4 * ROW + splats + pixels * 160, own * 2 * STATE) / 1e9,
        state=own * STATE / 1e9,
        whole=gaussians * (ROW + THERE) / 1e9,
    )


def pieces_sent(seen: float) -> int:
    """Returns the pieces that are sent if a view shows this fraction of the rows; `PIECES` are all rows."""
    pieces = math.ceil(seen * PIECES)
    return pieces if pieces <= MOST else PIECES


def exchanges(seen: float) -> int:
    """Returns the exchanges of splats in a step, each way: one for each piece, or one for all rows."""
    pieces = pieces_sent(seen)
    return pieces if pieces < PIECES else 1


def bytes_exchanged(rows: int, seen: float) -> int:
    """Returns the bytes that a device gets in a step that draws one view on it, there and back.

    Args:
        rows: of the scene.
        seen: the largest fraction of the rows of a device that a view shows.
    """
    return rows * FLAG + rows * pieces_sent(seen) // PIECES * (THERE + BACK)
