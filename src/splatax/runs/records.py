"""Records of runs in JSON (config.json, metrics.json, create.json, headers of checkpoints). They may be
edited or truncated: every error in one becomes a message of one sentence."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from splatax.errors import FormatError, InputError
from splatax.io.files import write_whole


@contextmanager
def understood(path: Path, way_out: str) -> Iterator[None]:
    """Turns every error that a damaged record causes, while it is read and used, into a `FormatError`.

    Args:
        path: of the record.
        way_out: a sentence for the message.

    Raises:
        FormatError: naming the file and what is wrong with it.
        FileNotFoundError: as raised inside; other errors of the file system too.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise FormatError(f"{path}: damaged ({error}). {way_out}") from error
    except Exception as error:
        raise FormatError(f"{path}: damaged ({reason(error)}). {way_out}") from error


def reason(error: Exception) -> str:
    """Returns what an error says about a record, in one line."""
    if isinstance(error, KeyError):
        return f"no {error} in it"
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")


def read_record(path: Path, way_out: str) -> dict[str, Any]:
    """Reads a file that holds one JSON object.

    Raises:
        FormatError: if it holds something else; see `understood`.
        FileNotFoundError: if there is none.
    """
    with understood(path, way_out):
        contents = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(contents, dict):
            raise TypeError("not a JSON object")
        return contents


def typed_fields(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values for fields of a dataclass from JSON values, each of the type that its field declares.

    Raises:
        TypeError: if one is of another type.
        KeyError: if the class has no such field.
    """
    hints = get_type_hints(cls)
    return {name: typed(value, hints[name], name) for name, value in values.items()}


def typed(value: Any, hint: Any, name: str) -> Any:
    """Returns a JSON value as a value of a type: a number, a word, a path, or one of several types.

    Raises:
        TypeError: if it is none.
    """
    kind, parts = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return typed(value, parts[0], name)
    if kind in (Union, UnionType):
        for part in parts:
            try:
                return typed(value, part, name)
            except TypeError:
                continue
    elif (kind is Literal and value in parts) or (hint is NoneType and value is None) or type(value) is hint:
        return value
    elif hint is float and type(value) is int:
        return float(value)
    elif hint is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"{name} is {str(value)[:40]!r}")


def as_json(value: Any) -> Any:
    """Returns a value as JSON values; a dataclass becomes its name and fields."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"type": type(value).__name__} | {
            f.name: as_json(getattr(value, f.name)) for f in fields(value)
        }
    if isinstance(value, Mapping):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def write_json(path: Path, contents: Any) -> None:
    """Writes a JSON file, whole or not at all; numbers that are not finite become null."""
    write_whole(path, (json.dumps(as_json(contents), indent=2) + "\n").encode())
