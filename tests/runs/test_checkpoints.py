"""The times at which a run saves itself, the files that are kept, and failures to save."""

import errno
import os
import threading
from dataclasses import fields

import numpy as np
import pytest

import splatax as sx
from shortened import shortened
from splatax.errors import InputError
from splatax.evaluation import Scores, ViewScore
from splatax.runs import checkpoints as module
from splatax.runs.checkpoints import Checkpoints, files
from splatax.runs.history import Evaluation, History, packed, unpacked
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint
from training.test_training import capture


@pytest.fixture(scope="module")
def state():
    """Of a run after its first step."""
    return next(sx.optimize(capture(), shortened("classic"))).state


@pytest.fixture
def at(state, monkeypatch):
    """Lets a state say that it is of another step."""
    take = checkpoint.take

    def set_step(step):
        def taken(*arguments):
            copy = take(*arguments)
            return Checkpoint({**copy.header, "step": step}, copy.arrays)

        monkeypatch.setattr(checkpoint, "take", taken)
        return state

    return set_step


@pytest.fixture
def clock(monkeypatch):
    """A clock that only moves when told."""
    now = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def names(run):
    return [path.name for path in files(run)]


def fail_with(number):
    def fail(*_):
        raise OSError(number, os.strerror(number))

    return fail


def test_due_by_the_clock_or_by_count(tmp_path, clock, state):
    saves = Checkpoints(tmp_path, {}, seconds=120.0, steps=50)
    assert [step for step in range(1, 200) if saves.due(step)] == [50, 100, 150]
    clock[0] += 119
    assert not saves.due(201)
    clock[0] += 1
    assert saves.due(202)
    saves.save(state, History())
    saves.wait()
    assert not saves.due(203)
    clock[0] += 120
    assert saves.due(204)
    assert not Checkpoints(tmp_path, {}, seconds=0.0).due(10**6)


def test_the_last_two_are_kept_and_none_after_the_end(tmp_path, at):
    saves = Checkpoints(tmp_path, {"seed": 3})
    for step in (1, 2, 3):
        saves.save(at(step), History())
    saves.wait()
    assert names(tmp_path) == ["00000002.npz", "00000003.npz"]
    assert checkpoint.read(files(tmp_path)[-1]).header["run"] == {"seed": 3}
    saves.discard()
    assert list(tmp_path.iterdir()) == []


def test_a_new_run_removes_those_of_the_one_it_replaces(tmp_path, at):
    with Checkpoints(tmp_path, {}) as saves:
        saves.save(at(7), History())
    (tmp_path / "checkpoints" / ".00000008.npz.123.tmp").write_bytes(b"half")
    Checkpoints(tmp_path, {})
    assert list((tmp_path / "checkpoints").iterdir()) == []


def test_what_a_run_goes_on_from_is_kept_until_there_are_two_newer(tmp_path, at):
    with Checkpoints(tmp_path, {}) as saves:
        for step in (7, 9):
            saves.save(at(step), History())
    (tmp_path / "checkpoints" / ".00000012.npz.123.tmp").write_bytes(b"half")
    with Checkpoints(tmp_path, {}, earlier=files(tmp_path)[0]) as saves:  # because 9 is damaged
        assert names(tmp_path) == ["00000007.npz", "00000009.npz"]
        saves.save(at(8), History())
        saves.wait()
        assert names(tmp_path) == ["00000007.npz", "00000008.npz"]
        saves.save(at(9), History())
    assert names(tmp_path) == ["00000008.npz", "00000009.npz"]


def test_steps_go_on_while_one_is_written_and_a_second_waits(tmp_path, at, monkeypatch, clock):
    write, may_end, writing = checkpoint.write, threading.Event(), []

    def slow(file, copy):
        assert not writing
        writing.append(copy.step)
        assert may_end.wait(20)
        write(file, copy)
        writing.clear()

    monkeypatch.setattr(checkpoint, "write", slow)
    saves = Checkpoints(tmp_path, {}, seconds=1.0)
    saves.save(at(1), History())
    clock[0] += 5
    assert not saves.due(2)  # the first is not done
    assert names(tmp_path) == []
    may_end.set()
    saves.save(at(2), History())
    saves.wait()
    assert names(tmp_path) == ["00000001.npz", "00000002.npz"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_fails_is_told_and_leaves_the_last_one_whole(tmp_path, at, monkeypatch, call, number):
    saves = Checkpoints(tmp_path, {}, steps=1)
    saves.save(at(4), History())
    saves.wait()
    monkeypatch.setattr(os, call, fail_with(number))
    saves.save(at(5), History())
    saves._thread.join()
    words = rf"{tmp_path}/checkpoints: .*{os.strerror(number)}.*resume from 00000004.npz"
    with pytest.raises(InputError, match=words) as refusal:
        saves.due(6)
    assert refusal.value.options == (f"resume {tmp_path}",)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["00000004.npz"]
    assert checkpoint.read(files(tmp_path)[0]).step == 4


def test_a_disk_that_was_full_from_the_start_names_another_way(tmp_path, at, monkeypatch):
    monkeypatch.setattr(os, "fsync", fail_with(errno.ENOSPC))
    saves = Checkpoints(tmp_path, {})
    saves.save(at(4), History())
    with pytest.raises(InputError, match=r"No space left on device.*without checkpoints") as refusal:
        saves.wait()
    assert refusal.value.options == ("checkpoint_every 0",)
    assert names(tmp_path) == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to_is_told(tmp_path, at):
    (tmp_path / "checkpoints").mkdir(mode=0o500)
    saves = Checkpoints(tmp_path, {})
    saves.save(at(4), History())
    with pytest.raises(InputError, match="Permission denied"):
        saves.wait()


def test_leaving_waits_for_the_file_unless_the_user_stops_at_once(tmp_path, at, monkeypatch):
    may_end = threading.Event()
    write = checkpoint.write
    monkeypatch.setattr(checkpoint, "write", lambda file, copy: may_end.wait(20) and write(file, copy))

    def leave(step, error):
        with Checkpoints(tmp_path, {}) as saves:
            running.append(saves)
            saves.save(at(step), History())
            raise error

    running = []
    with pytest.raises(KeyboardInterrupt):
        leave(1, KeyboardInterrupt)
    thread = running[0]._thread
    assert thread.is_alive()
    assert thread.daemon  # so that the process can end
    may_end.set()
    thread.join()
    with pytest.raises(ZeroDivisionError):
        leave(2, ZeroDivisionError)
    assert names(tmp_path) == ["00000002.npz"]


def test_a_history_comes_back(tmp_path, at):
    measures = [20.123456789 + i for i in range(len(fields(ViewScore)) - 1)]
    scores = Scores((ViewScore("a.png", float("inf"), *measures[1:]), ViewScore("b.png", *measures)))
    pictures = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    history = History(
        losses=[np.float32(0.1), np.float32(0.2)],
        counts=[10, 12],
        evaluations=[Evaluation(2, 1.5, scores)],
        frames=[("step 1", pictures), ("step 2", pictures + 1)],
        train_seconds=12.25,
    )
    with Checkpoints(tmp_path, {}) as saves:
        saves.save(at(2), history)
    header, arrays = packed(history)
    saved = checkpoint.read(files(tmp_path)[0])
    back = unpacked(dict(saved.header), dict(saved.arrays))
    again_header, again_arrays = packed(back)
    assert again_header == header
    assert back.evaluations == history.evaluations
    assert back.losses == [float(np.float32(0.1)), float(np.float32(0.2))]
    for name, array in arrays.items():
        np.testing.assert_array_equal(again_arrays[name], array)
