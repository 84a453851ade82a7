"""The command line: the library's first user."""

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
from splatax.cli.failures import advice, sentence
from splatax.cli.inspect import Inspect
from splatax.cli.interruption import STOPPED
from splatax.cli.output import complain, guarded
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
REFUSED = 2  # exit code
DESCRIPTION = "3D Gaussian Splatting in JAX: from photos to a scene, on CPU, GPU and TPU."


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command. Bad input ends in one sentence on standard error and exit code 2."""
    with guarded():
        command = tyro.cli(
            Command,
            args=arguments,
            prog="splatax",
            description=DESCRIPTION,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        )
        warnings.showwarning = lambda message, *_: complain(f"warning: {message}")  # without lines of code
        keep_compiled_programs()
        keep_freed_memory()
        try:
            command.run()
        except InputError as error:
            complain(advice(error, command))
            sys.exit(REFUSED)
        except OSError as error:
            complain(sentence(error))
            sys.exit(REFUSED)
        except KeyboardInterrupt:
            sys.exit(STOPPED)
