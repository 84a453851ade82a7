"""The processes of `splatax train --hosts`: joining, and sending the decisions of process 0.

All processes make every step; process 0 decides about the run and writes its results. Work that gathers the
scene from all devices (evaluation, pictures, checkpoints) is done by all processes after the same steps, so
none of it may depend on the clock.
"""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import jax

from splatax.cli.options import flag
from splatax.cli.output import say
from splatax.cli.preparing import loaded
from splatax.cli.settings import Settings
from splatax.cli.starting import Run
from splatax.cli.train_options import Live, Saving
from splatax.dataset import Dataset
from splatax.errors import InputError
from splatax.runs.machine import processor, versions
from splatax.runs.records import as_json, typed_fields
from splatax.runs.resume import DECISIVE
from splatax.training.processes import announce_exit, broadcast, receive, require_same

FILES = ("points", "cameras")  # settings that name files which process 0 has, and the others may not
OWN = ("scene", "hold_out", "memory")  # settings that name what each process has for itself
CHECKPOINT_STEPS = 500  # between checkpoints, unless the user chooses
LEAVING = 30  # seconds that a process which exits waits for the others to exit too


@contextmanager
def joined(hosts: str | None) -> Iterator[None]:
    """Joins the processes of a run; all but process 0 print nothing. Nothing may have used JAX before.

    Args:
        hosts: "auto" where JAX finds them (SLURM, Open MPI, Kubernetes, TPU pods), else "ADDRESS,COUNT,INDEX"
            with the host:port of process 0. None for a single process.

    Raises:
        InputError: if the text is none of these, the processes do not find each other, or their processors or
            versions differ.
    """
    if hosts is None:
        yield
        return
    _join(hosts)
    try:
        require_same({name: versions()[name] for name in DECISIVE} | {"processor": processor()})
        if jax.process_index() == 0:
            yield
            return
        with Path(os.devnull).open("w") as nothing, redirect_stdout(nothing):
            yield
    except BaseException as error:
        announce_exit(str(error) or type(error).__name__)
        raise


def _join(hosts: str) -> None:
    named = re.fullmatch(r"([^,]+:\d+),(\d+),(\d+)", hosts)
    if hosts != "auto" and not named:
        raise InputError(f"--hosts {hosts}: auto, or ADDRESS:PORT,COUNT,INDEX such as 10.0.0.1:8476,2,0.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    address, count, index = (named[1], int(named[2]), int(named[3])) if named else (None, None, None)
    try:
        jax.distributed.initialize(address, count, index, shutdown_timeout_seconds=LEAVING)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"--hosts {hosts}: the processes did not find each other ({error}). "
            "Start all of them, and name them: --hosts ADDRESS:PORT,COUNT,INDEX."
        ) from error


def among_processes(run: Run, saving: Saving, live: Live) -> Run:
    """Returns a run for several processes, which saves checkpoints by steps because their clocks differ.

    Args:
        run: as the user asks for it.
        saving: options as given; those that are not given may come from the run that is resumed.
        live: the live viewer.

    Raises:
        InputError: if only one process can make such a run.
    """
    if run.settings.views == 1 or live.view:
        raise InputError("--hosts: needs --views, and cannot be used with --view.")
    if saving.checkpoint_every:
        raise InputError(
            f"{flag('checkpoint_every')} {saving.checkpoint_every:g}: several processes cannot save by the "
            f"clock, because their clocks differ. Give {flag('checkpoint_steps')} N instead."
        )
    steps = run.settings.checkpoint_steps
    if saving.checkpoint_steps is None:
        steps = steps or CHECKPOINT_STEPS
        say(f"saving a checkpoint every {steps:,} steps. Choose another number: {flag('checkpoint_steps')}")
    return replace(run, settings=replace(run.settings, checkpoint_every=0.0, checkpoint_steps=steps))


def send_settings(settings: Settings) -> None:
    """Sends the settings that process 0 has decided, and the files that they name, to the other processes."""
    if jax.process_count() == 1:
        return
    broadcast(json.dumps(as_json(asdict(settings))).encode())
    for name in FILES:
        path = getattr(settings, name)
        broadcast(path.read_bytes() if path else b"")


def receive_settings(settings: Settings) -> tuple[Settings, Dataset]:
    """Returns the settings that process 0 has decided, and this process's capture under them.

    Args:
        settings: of this process, as given.
    """
    decided = Settings(**typed_fields(Settings, json.loads(receive())))
    decided = replace(decided, **{name: getattr(settings, name) for name in OWN})
    with TemporaryDirectory(prefix="splatax-") as folder:
        for name in FILES:
            contents, path = receive(), getattr(decided, name)
            if path:
                here = Path(folder) / path.name
                here.write_bytes(contents)
                decided = replace(decided, **{name: here})
        return decided, loaded(decided)
