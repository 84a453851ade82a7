"""The command line: the library's first user."""

import functools
import io
import operator
import sys
import warnings
from collections.abc import Collection, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import make_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import splatax
from splatax.cli.choices import OPTIONAL_CHOICES
from splatax.cli.commands import COMMANDS
from splatax.cli.failures import advice
from splatax.cli.interruption import STOPPED
from splatax.cli.output import complain, guarded, say
from splatax.cli.paragraphs import in_paragraphs
from splatax.cli.platform import keep_compiled_programs, keep_freed_memory
from splatax.errors import InputError
from splatax.io.files import explained

REFUSED = 2  # exit code
DESCRIPTION = (
    "3D Gaussian Splatting in JAX: from photos to a scene, on CPU, GPU and TPU. --version prints the version."
)


def choices(named: Collection[str], imported: Collection[str]) -> Any:
    """Returns the type of all commands.

    Args:
        named: names of commands that are described by all of their help; the others are, in the list of
            commands, by its first line.
        imported: names of the commands to import. The others have no options.
    """
    described = (
        Annotated[
            command.load() if name in imported else make_dataclass(name, []),
            tyro.conf.subcommand(name, description=None if name in named else command.summary),
        ]
        for name, command in COMMANDS.items()
    )
    return functools.reduce(operator.or_, described)


def parsed(given: Sequence[str]) -> Any:
    """Returns the command that the arguments ask for, of which only the named ones are imported.

    Exits if they are not understood. Only then all commands are imported, because the message suggests
    options that other commands have.
    """
    named = COMMANDS.keys() & set(given)
    understand = functools.partial(
        tyro.cli,
        args=given,
        prog="splatax",
        description=DESCRIPTION,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
    )
    if {"-h", "--help"} & set(given):
        for name in named:
            in_paragraphs(COMMANDS[name].load())
        return understand(choices(named, named))
    commands = choices(named, named)
    unprinted = io.StringIO()
    try:
        with redirect_stdout(unprinted), redirect_stderr(unprinted):
            return understand(commands)
    except SystemExit:
        return understand(choices(named, COMMANDS))


def with_home(argument: str) -> str:
    """Returns an argument with the user's folder in place of ~ in --option=~/path, where shells leave it."""
    option, equals, value = argument.partition("=")
    if option.startswith("--") and value.partition("/")[0] == "~":
        return f"{option}{equals}{Path(value).expanduser()}"
    return argument


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command. Bad input ends in one sentence on standard error and exit code 2."""
    with guarded():
        given = sys.argv[1:] if arguments is None else list(arguments)
        if given == ["--version"]:
            say(f"splatax {splatax.__version__}")
            return
        with OPTIONAL_CHOICES:
            command = parsed([with_home(text) for text in given])
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
