"""The command line: the library's first user."""

import errno
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated

import tyro

from splatax.cli.bench import Bench
from splatax.cli.compare import Compare
from splatax.cli.create import Create
from splatax.cli.demo import Demo
from splatax.cli.doctor import Doctor
from splatax.cli.evaluate import Evaluate
from splatax.cli.export import Export
from splatax.cli.inspect import Inspect
from splatax.cli.interruption import STOPPED
from splatax.cli.page import Page
from splatax.cli.platform import keep_compiled_programs, keep_freed_memory
from splatax.cli.reconstruct import Reconstruct
from splatax.cli.render import Render
from splatax.cli.train import Train
from splatax.cli.view import View
from splatax.errors import InputError

Command = (
    Annotated[Create, tyro.conf.subcommand("create")]
    | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Page, tyro.conf.subcommand("page")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)
REASONS = {  # why a file cannot be used, and the way out, where the system says less
    errno.EEXIST: "a file, where a folder is needed. Choose another place.",
    errno.ENOTDIR: "lies below a file, where a folder is needed. Choose another place.",
    errno.EISDIR: "a folder, where a file is needed. Choose another name.",
    errno.EACCES: "not permitted. Choose a place that you may use.",
    errno.EPERM: "not permitted. Choose a place that you may use.",
    errno.EROFS: "on a disk that cannot be written to. Choose another place.",
    errno.ENOSPC: "no space is left on the disk. Free some, and run it again.",
}
DESCRIPTION = "3D Gaussian Splatting in JAX: from photos to a scene, on CPU, GPU and TPU."


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command. Bad input is one sentence on stderr and exit code 2, never a traceback."""
    command = tyro.cli(
        Command,
        args=arguments,
        prog="splatax",
        description=DESCRIPTION,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
    )
    warnings.formatwarning = lambda message, *_: f"splatax: warning: {message}\n"  # without lines of code
    keep_compiled_programs()
    keep_freed_memory()
    try:
        command.run()
    except InputError as error:
        sys.exit(_refused(error))
    except OSError as error:
        reason = REASONS.get(error.errno or 0, f"{error.strerror or error}.")
        sys.exit(_refused(f"{error.filename or 'a file'}: {reason}"))
    except KeyboardInterrupt:
        sys.exit(STOPPED)


def _refused(reason: object) -> int:
    print(f"splatax: {reason}", file=sys.stderr)
    return 2
