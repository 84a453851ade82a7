"""The command line: the library's first user."""

import functools
import operator
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

import splatax
from splatax.cli.animate import Animate
from splatax.cli.bench import Bench
from splatax.cli.bind import Bind
from splatax.cli.blocks import Blocks
from splatax.cli.cache import Cache
from splatax.cli.compare import Compare
from splatax.cli.compose import Compose
from splatax.cli.create import Create
from splatax.cli.demo import Demo
from splatax.cli.doctor import Doctor
from splatax.cli.evaluate import Evaluate
from splatax.cli.export import Export
from splatax.cli.failures import advice
from splatax.cli.inspect import Inspect
from splatax.cli.interruption import STOPPED
from splatax.cli.label import Label
from splatax.cli.mesh import Mesh
from splatax.cli.metres import Metres
from splatax.cli.output import complain, guarded, say
from splatax.cli.page import Page
from splatax.cli.paragraphs import in_paragraphs
from splatax.cli.plan import Plan
from splatax.cli.platform import keep_compiled_programs, keep_freed_memory
from splatax.cli.reconstruct import Reconstruct
from splatax.cli.render import Render
from splatax.cli.rig import RigCommand
from splatax.cli.train import Train
from splatax.cli.view import View
from splatax.errors import InputError
from splatax.io.files import explained

COMMANDS = {
    "create": Create,
    "reconstruct": Reconstruct,
    "inspect": Inspect,
    "train": Train,
    "eval": Evaluate,
    "render": Render,
    "view": View,
    "compare": Compare,
    "export": Export,
    "mesh": Mesh,
    "page": Page,
    "compose": Compose,
    "bind": Bind,
    "rig": RigCommand,
    "animate": Animate,
    "label": Label,
    "metres": Metres,
    "demo": Demo,
    "bench": Bench,
    "cache": Cache,
    "plan": Plan,
    "blocks": Blocks,
    "doctor": Doctor,
}
REFUSED = 2  # exit code
DESCRIPTION = (
    "3D Gaussian Splatting in JAX: from photos to a scene, on CPU, GPU and TPU. --version prints the version."
)


def choices(brief: bool) -> Any:
    """Returns the type of all commands.

    Args:
        brief: describe each with the first sentence of its help, for the list of commands.
    """
    described = (
        Annotated[
            command,
            tyro.conf.subcommand(
                name, description=(command.__doc__ or "").splitlines()[0] if brief else None
            ),
        ]
        for name, command in COMMANDS.items()
    )
    return functools.reduce(operator.or_, described)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command. Bad input ends in one sentence on standard error and exit code 2."""
    with guarded():
        given = sys.argv[1:] if arguments is None else list(arguments)
        if given == ["--version"]:
            say(f"splatax {splatax.__version__}")
            return
        if {"-h", "--help"} & set(given):
            for options in COMMANDS.values():
                in_paragraphs(options)
        command = tyro.cli(
            choices(brief=not COMMANDS.keys() & set(given)),
            args=given,
            prog="splatax",
            description=DESCRIPTION,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
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
            complain(explained(error))
            sys.exit(REFUSED)
        except KeyboardInterrupt:
            sys.exit(STOPPED)
