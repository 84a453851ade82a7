"""Training by several processes, on one host or many. All make every step; process 0 keeps the results.

Work that gathers the scene from all devices (evaluation, pictures, checkpoints) is done by all processes
after the same steps, so none of it may depend on the clock.
"""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import jax

from splatax.errors import InputError


@contextmanager
def joined(hosts: str | None) -> Iterator[None]:
    """Joins the processes of a run; all but process 0 print nothing. Nothing may have used JAX before.

    Args:
        hosts: "auto" where JAX finds them (SLURM, Open MPI, Kubernetes, TPU pods), else "ADDRESS,COUNT,INDEX"
            with the host:port of process 0. None for a single process.

    Raises:
        InputError: if the text is none of these, or the processes do not find each other.
    """
    if hosts is None:
        yield
        return
    named = re.fullmatch(r"([^,]+:\d+),(\d+),(\d+)", hosts)
    if hosts != "auto" and not named:
        raise InputError(f"--hosts {hosts}: auto, or ADDRESS:PORT,COUNT,INDEX such as 10.0.0.1:8476,2,0.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        if named:
            jax.distributed.initialize(named[1], int(named[2]), int(named[3]))
        else:
            jax.distributed.initialize()
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"--hosts {hosts}: the processes did not find each other ({error}). "
            "Start all of them, and name them: --hosts ADDRESS:PORT,COUNT,INDEX."
        ) from error
    if jax.process_index() == 0:
        yield
        return
    with Path(os.devnull).open("w") as nothing, redirect_stdout(nothing):
        yield


@contextmanager
def kept_by_one(out: Path) -> Iterator[Path]:
    """Gives process 0 the output folder, and each of the others a temporary one."""
    if jax.process_index() == 0:
        yield out
        return
    with tempfile.TemporaryDirectory(prefix="splatax-") as folder:
        yield Path(folder)
