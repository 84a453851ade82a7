"""The processes of a run that `jax.distributed` has joined: messages, and the check that all agree.

They communicate through the key-value store of `jax.distributed`, not by collective operations on devices,
which may time out: a process waits for as long as another works, and is told if another exits.
"""

import itertools
import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import jax
from jax._src import distributed  # the store has no public name

from splatax.errors import InputError

PART = 1 << 20  # bytes of one entry: gRPC limits messages to 4 MB
POLL = 2_000  # ms of one wait for an entry, after which a process looks whether another has exited
EXITS = "splatax/exits"  # folder of entries of processes that have exited early
_numbers = itertools.count()  # of messages: all processes send and await the same ones, in the same order


def broadcast(value: bytes) -> None:
    """Sends bytes from process 0, which calls this, to all others, which call `receive`."""
    name = _next_name()
    if _state().num_processes > 1:
        _write(name, value)


def receive() -> bytes:
    """Returns the bytes that process 0 broadcasts, for which it waits as long as it takes.

    Raises:
        InputError: if another process has exited meanwhile.
    """
    return _read(_next_name())


def all_gather(value: bytes) -> list[bytes]:
    """Returns the bytes that each process gives, in the order of the processes. All of them call this.

    Raises:
        InputError: if another process has exited meanwhile.
    """
    name = _next_name()
    if _state().num_processes == 1:
        return [value]
    _write(f"{name}/{_state().process_id}", value)
    return [_read(f"{name}/{index}") for index in range(_state().num_processes)]


def announce_exit(reason: str) -> None:
    """Tells the other processes that this one exits early, so that none waits for it."""
    text = f"process {_state().process_id} has ended the run: {reason}"
    with suppress(jax.errors.JaxRuntimeError):  # process 0 and its store may have exited first
        _client().key_value_set(f"{EXITS}/{_state().process_id}", text)


def require_same(facts: Mapping[str, str]) -> None:
    """Compares facts about a run among its processes, all of which call this.

    Args:
        facts: short texts, by what they are about.

    Raises:
        InputError: if they differ, in every process.
    """
    first, *others = (json.loads(text) for text in all_gather(json.dumps(facts).encode()))
    for index, other in enumerate(others, 1):
        differing = [name for name in {**first, **other} if first.get(name) != other.get(name)]
        if differing:
            name = differing[0]
            both = f"{first.get(name)} in process 0 and {other.get(name)} in process {index}"
            raise InputError(
                f"the processes of the run differ in: {', '.join(differing)} ({name}: {both}). "
                "Give all of them the same."
            )


def _next_name() -> str:
    return f"splatax/{next(_numbers)}"


def _write(name: str, value: bytes) -> None:
    parts = [value[begin : begin + PART] for begin in range(0, len(value), PART)]
    for number, part in enumerate(parts):
        _client().key_value_set_bytes(f"{name}/part/{number}", part)
    _client().key_value_set_bytes(f"{name}/parts", str(len(parts)).encode())


def _read(name: str) -> bytes:
    count = int(_entry(f"{name}/parts"))
    return b"".join(_entry(f"{name}/part/{number}") for number in range(count))


def _entry(key: str) -> bytes:
    """Returns an entry of the store, once it is there."""
    while (value := _polled(key)) is None:
        _require_no_exit()
    return value


def _polled(key: str) -> bytes | None:
    """Returns an entry of the store; None if it is not there after `POLL`."""
    try:
        return bytes(_client().blocking_key_value_get_bytes(key, POLL))
    except jax.errors.JaxRuntimeError as error:
        if "DEADLINE_EXCEEDED" in str(error):
            return None
        raise InputError(
            f"process 0 cannot be reached any more ({error}). Its messages say why; resume the run."
        ) from error


def _require_no_exit() -> None:
    for _, reason in _client().key_value_dir_get(EXITS):
        raise InputError(reason)


def _client() -> Any:
    return _state().client


def _state() -> Any:
    # Not `jax.process_count()`, which waits two minutes at most for the devices of all processes.
    return distributed.global_state
