"""Checks of the values in tables of a .toml file. Each error names the table and the key."""

from collections.abc import Mapping
from typing import Any

from splatax.shapes import is_number


def table(where: str, value: Any, known: tuple[str, ...] | None = None) -> dict[str, Any]:
    """Returns a value that must be a table, whose keys are some of the known ones.

    Raises:
        ValueError: if it is none, or has another key.
    """
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {value!r}, not a table")
    for key in value:
        if known is not None and key not in known:
            raise ValueError(f"{where} has {key!r}, which is not one of {', '.join(known)}")
        if not key:
            raise ValueError(f"{where} has an empty name")
    return value


def needed(where: str, row: Mapping[str, Any], key: str) -> Any:
    """Returns the value of a key that a table must have.

    Raises:
        ValueError: if it is missing.
    """
    if key not in row:
        raise ValueError(f"{where} needs {key!r}, which is missing")
    return row[key]


def text(what: str, value: Any) -> str:
    """Returns a value that must be text.

    Raises:
        ValueError: if it is not.
    """
    if not isinstance(value, str):
        raise ValueError(f"{what} is {value!r}, not text in quotation marks")
    return value


def number(what: str, value: Any) -> float:
    """Returns a value that must be a finite number.

    Raises:
        ValueError: if it is not.
    """
    if not is_number(value):
        raise ValueError(f"{what} is {value!r}, not a number")
    return float(value)


def numbers(what: str, values: Any, count: int) -> tuple[float, ...]:
    """Returns a value that must be a list of finite numbers.

    Raises:
        ValueError: if it is not, or has another length.
    """
    found = values if isinstance(values, list | tuple) else []
    if len(found) != count or not all(map(is_number, found)):
        raise ValueError(f"{what} is {values!r}, not {count} numbers")
    return tuple(map(float, found))


def color(what: str, values: Any) -> tuple[float, float, float]:
    """Returns three numbers that must not be negative.

    Raises:
        ValueError: if they are none or one is below 0.
    """
    red, green, blue = numbers(what, values, 3)
    if min(red, green, blue) < 0:
        raise ValueError(f"{what} is {values!r}, and a colour has no number below 0")
    return red, green, blue


def flag(what: str, value: Any) -> bool:
    """Returns a value that must be true or false.

    Raises:
        ValueError: if it is not.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{what} is {value!r}, not true or false")
    return value
