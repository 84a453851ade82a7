"""The processes of a run that `jax.distributed` has joined: messages, and the check that all agree.

They speak through the key-value store of `jax.distributed`, not by collective operations on devices, which
may time out: a process waits for as long as another works, and hears if another ends.
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
PATIENCE = 2_000  # ms of one wait, after which a process looks whether another has ended
ENDED = "splatax/ended"  # folder of entries of processes that have ended early
_numbers = itertools.count()  # of messages: all processes send and await the same ones, in the same order


def from_first(value: bytes | None = None) -> bytes:
    """Returns the value that process 0 gives. The others wait for it, as long as it takes.

    Args:
        value: of process 0; None in the others.

    Raises:
        InputError: if another process has ended meanwhile.
    """
    name = _next_name()
    if value is None:
        return _read(name)
    if _state().num_processes > 1:
        _write(name, value)
    return value


def from_all(value: bytes) -> list[bytes]:
    """Returns the values that all processes give, in the order of the processes.

    Raises:
        InputError: if another process has ended meanwhile.
    """
    name = _next_name()
    if _state().num_processes == 1:
        return [value]
    _write(f"{name}/{_state().process_id}", value)
    return [_read(f"{name}/{index}") for index in range(_state().num_processes)]


def tell_the_end(reason: str) -> None:
    """Tells the other processes that this one ends early, so that none waits for it."""
    text = f"process {_state().process_id} has ended the run: {reason}"
    with suppress(jax.errors.JaxRuntimeError):  # process 0 and its store may have ended first
        _client().key_value_set(f"{ENDED}/{_state().process_id}", text)


def require_alike(facts: Mapping[str, str]) -> None:
    """Compares facts about a run among its processes, all of which call this.

    Args:
        facts: short texts, by what they are about.

    Raises:
        InputError: if they differ, in every process.
    """
    first, *others = (json.loads(text) for text in from_all(json.dumps(facts).encode()))
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
    count = int(_awaited(f"{name}/parts"))
    return b"".join(_awaited(f"{name}/part/{number}") for number in range(count))


def _awaited(name: str) -> bytes:
    while True:
        try:
            return bytes(_client().blocking_key_value_get_bytes(name, PATIENCE))
        except jax.errors.JaxRuntimeError as error:
            if "DEADLINE_EXCEEDED" not in str(error):
                reason = (
                    f"process 0 cannot be reached any more ({error}). Its messages say why; resume the run."
                )
                raise InputError(reason) from error
        for _, text in _client().key_value_dir_get(ENDED):
            raise InputError(text)


def _client() -> Any:
    return _state().client


def _state() -> Any:
    # Not `jax.process_count()`, which waits two minutes at most for the devices of all processes.
    return distributed.global_state
