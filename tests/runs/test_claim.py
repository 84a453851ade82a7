"""Two processes never write to one folder at the same time."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from splatax.errors import InputError
from splatax.runs.claim import LOCK, claimed

HOLD = """
import sys, time
from pathlib import Path
from splatax.runs.claim import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def other(tmp_path):
    """Another process that holds the folder `run`."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.mark.slow
def test_a_folder_is_held_until_its_process_ends_whatever_ends_it(other, tmp_path):
    run = tmp_path / "run"
    with (
        pytest.raises(InputError, match=rf"{run}: process {other.pid} is writing to this folder"),
        claimed(run),
    ):
        pass
    other.send_signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
    other.wait()
    assert (run / LOCK).exists()  # left behind, and in nobody's way
    with claimed(run):
        assert (run / LOCK).read_text() == str(os.getpid())
    assert list(run.iterdir()) == []


def test_a_folder_is_free_again_after_a_failure_and_nothing_is_left(tmp_path):
    run = tmp_path / "run"
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), claimed(run):
            raise ZeroDivisionError
    assert not run.exists()  # it was made for nothing


def test_a_folder_that_cannot_be_written_to_names_its_disk(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    with (
        pytest.raises(InputError, match=r"cannot be written to .*the disk at /"),
        claimed(tmp_path / "run"),
    ):
        pass


def test_a_folder_below_a_file_is_refused_as_such(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="lies below a file"), claimed(tmp_path / "file" / "run"):
        pass


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with pytest.warns(UserWarning, match="cannot lock files"), claimed(tmp_path / "run"):
        pass
