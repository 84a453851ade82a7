"""Messages of commands that fail."""

from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from splatax.errors import InputError


def advice(error: InputError, command: Any) -> str:
    """Returns the message of an error, followed by the options of a command that help."""
    known = names_of(type(command))
    named = [option.partition(" ") for option in error.options]
    flags = [f"--{name.replace('_', '-')}{space}{value}" for name, space, value in named if name in known]
    return f"{error} See {', '.join(flags)}." if flags else str(error)


def names_of(options: type) -> set[str]:
    """Returns the names of a command's options, those in groups too."""
    hints = get_type_hints(options)
    names = {field.name for field in fields(options)}
    return names.union(*(names_of(hints[name]) for name in names if is_dataclass(hints[name])))
