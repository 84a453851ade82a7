"""Messages between the processes of a run, and their comparison of what they are about to train."""

import socket
import subprocess
import sys

import pytest

from splatax.errors import InputError
from splatax.training import processes

BEGIN = """
import sys, time
import jax
port, index = sys.argv[1], int(sys.argv[2])
jax.distributed.initialize(f"127.0.0.1:{port}", 2, index, shutdown_timeout_seconds=20)
from splatax.errors import InputError
from splatax.training import processes
"""


def printed_by_two(body):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    both = [
        subprocess.Popen([sys.executable, "-c", BEGIN + body, port, index], stdout=subprocess.PIPE, text=True)
        for index in ("0", "1")
    ]
    outputs = [process.communicate(timeout=200)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    return [[line for line in output.splitlines() if not line.startswith("[Gloo]")] for output in outputs]


@pytest.mark.slow
def test_processes_wait_for_what_process_0_broadcasts_and_for_what_all_gather():
    body = """
if index == 0:
    time.sleep(3)  # longer than one wait
    processes.broadcast(bytes(range(256)) * 20_000)
else:
    print(processes.receive() == bytes(range(256)) * 20_000)
print(processes.all_gather(str(index).encode()))
if index == 0:
    processes.broadcast(b"")
else:
    print(processes.receive())
"""
    gathered = "[b'0', b'1']"
    assert printed_by_two(body) == [[gathered], ["True", gathered, "b''"]]


@pytest.mark.slow
def test_a_process_that_exits_early_is_not_waited_for():
    body = """
try:
    if index == 0:
        raise ValueError("no such capture")
    processes.receive()
except ValueError as error:
    if index == 0:
        processes.announce_exit(error)
    print(type(error).__name__, error)
"""
    exited = "InputError process 0 has ended the run: no such capture"
    assert printed_by_two(body) == [["ValueError no such capture"], [exited]]


def test_a_difference_between_processes_is_named_with_both_values(monkeypatch):
    other = b'{"points": "30", "recipe": "b"}'
    monkeypatch.setattr(processes, "all_gather", lambda own: [own, own, other])
    with pytest.raises(
        InputError, match=r"differ in: points \(points: 29 in process 0 and 30 in process 2\)"
    ):
        processes.require_same({"points": "29", "recipe": "b"})


def test_a_single_process_needs_no_store():
    processes.broadcast(b"settings")
    assert processes.all_gather(b"facts") == [b"facts"]
    processes.require_same({"points": "30"})
