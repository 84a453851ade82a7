"""Help texts of options as paragraphs: docstrings are wrapped for their source, help for the terminal."""

import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from functools import cache
from typing import Annotated, get_args, get_type_hints

import docstring_parser
import tyro


@cache
def in_paragraphs(options: type) -> None:
    """Gives options their docstrings as help texts without line breaks inside paragraphs.

    Args:
        options: class of a command or of a group of options. Its annotations change, and those of its groups.
    """
    for group in groups_of(options):
        in_paragraphs(group)
    for kind in options.__mro__[:-1]:
        own = vars(kind).get("__annotations__", {})
        for described in docstring_parser.parse_from_object(kind).params:
            if described.arg_name in own and described.description:
                text = reflowed(described.description)
                own[described.arg_name] = Annotated[own[described.arg_name], tyro.conf.arg(help=text)]


def groups_of(options: type) -> Iterator[type]:
    """Yields the classes of the groups in the options of a command, and of its own commands."""
    for hint in get_type_hints(options).values():
        for kind in (hint, *get_args(hint)):
            if isinstance(kind, type) and is_dataclass(kind):
                yield kind


def reflowed(text: str) -> str:
    """Returns a text with its paragraphs on one line each."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text))
