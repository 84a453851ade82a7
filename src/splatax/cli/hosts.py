"""Training by several processes, on one host or many. All make every step; process 0 decides and keeps.

Work that gathers the scene from all devices (evaluation, pictures, checkpoints) is done by all processes
after the same steps, so none of it may depend on the clock.
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

from splatax.cli.preparing import loaded
from splatax.cli.settings import Settings
from splatax.dataset import Dataset
from splatax.errors import InputError
from splatax.io.memory import decoding
from splatax.runs.budget import Changes
from splatax.runs.checkpoints import NoCheckpoints
from splatax.runs.history import History
from splatax.runs.keeping import with_photos_kept
from splatax.runs.machine import processor, versions
from splatax.runs.planning import room_within
from splatax.runs.records import as_json, typed_fields
from splatax.runs.resume import DECISIVE, Earlier
from splatax.runs.session import Following
from splatax.training.processes import from_first, require_alike, tell_the_end

FILES = ("points", "cameras")  # settings that name files which process 0 has, and the others may not
OWN = ("scene", "hold_out", "memory")  # settings that name what each process has for itself
LEAVING = 30  # seconds that a process which ends waits for the others to end too


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
    try:
        require_alike({name: versions()[name] for name in DECISIVE} | {"processor": processor()})
        if jax.process_index() == 0:
            yield
            return
        with Path(os.devnull).open("w") as nothing, redirect_stdout(nothing):
            yield
    except BaseException as error:
        tell_the_end(str(error) or type(error).__name__)
        raise


def tell(settings: Settings) -> None:
    """Tells the other processes, if any, what process 0 has decided: settings, and files that they name."""
    if jax.process_count() == 1:
        return
    from_first(json.dumps(as_json(asdict(settings))).encode())
    for name in FILES:
        path = getattr(settings, name)
        from_first(path.read_bytes() if path else b"")


def heard(settings: Settings) -> tuple[Settings, Dataset]:
    """Returns the settings that process 0 has decided, and this process's capture under them.

    Args:
        settings: of this process, as given.
    """
    decided = Settings(**typed_fields(Settings, json.loads(from_first())))
    decided = replace(decided, **{name: getattr(settings, name) for name in OWN})
    with TemporaryDirectory(prefix="splatax-") as folder:
        for name in FILES:
            contents, path = from_first(), getattr(decided, name)
            if path:
                here = Path(folder) / path.name
                here.write_bytes(contents)
                decided = replace(decided, **{name: here})
        return decided, loaded(decided)


def follow(settings: Settings, history: History, earlier: Earlier | None) -> None:
    """Makes the steps of a run that process 0 decides about, and waits until its results are written.

    Args:
        settings: of this process, as given.
        history: record of the run until now.
        earlier: the run to resume.
    """
    settings, dataset = heard(settings)
    room = room_within(settings.memory_bytes, dataset, settings.initialization().number(dataset))
    decoding.limit = room.decoding
    recipe = settings.to_recipe(dataset)
    reading, _ = with_photos_kept(dataset, room)
    session = Following(
        reading,
        recipe,
        NoCheckpoints(settings.checkpoint_steps),
        history,
        Changes(history.changes),
        eval_every=settings.eval_every,
        photo_room=room.photos,
    )
    for _ in session.steps(earlier.state(recipe, dataset) if earlier else None):
        pass
    from_first()
