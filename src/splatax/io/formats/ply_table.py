"""Reads and writes PLY files as tables of named columns, independent of their meaning."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.errors import FormatError, shown
from splatax.io.damage import blamed_on
from splatax.io.files import write_whole

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
NAMES = {"f4": "float", "u4": "uint", "u1": "uchar"}  # PLY's names of the types that are written
ENDIANNESS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
LONGEST_HEADER = 1 << 20  # bytes; a file without end_header is read no further


@dataclass(frozen=True)
class PlyTable:
    """Comments of a PLY file, and the rows of each element as a structured array."""

    comments: tuple[str, ...]
    elements: dict[str, np.ndarray]


def read(path: Path) -> PlyTable:
    """Reads a PLY file of fixed-size properties; an element with a list, and all after it, are left out.

    Raises:
        FormatError: if the file is not a PLY file, or is shorter than its header says.
    """
    with path.open("rb") as file:
        lines, start = _header_of(path, file.read(LONGEST_HEADER))
        form, comments, layout = _parse(path, lines)
        elements: dict[str, np.ndarray] = {}
        file.seek(start)
        remaining = os.fstat(file.fileno()).st_size - start
        for name, count, fields in layout:
            if fields is None:
                break
            if not fields:
                continue
            dtype = np.dtype([(column, ENDIANNESS[form] + kind) for column, kind in fields.items()])
            if form == "ascii":
                if len(fields) * count > remaining:  # less than one digit for each number
                    raise FormatError(
                        f"{path}: truncated: {count:,} {shown(name)} rows do not fit in this file."
                    )
                elements[name] = _read_text(path, file, name, count, dtype)
                continue
            remaining -= count * dtype.itemsize
            if remaining < 0:
                raise FormatError(
                    f"{path}: truncated: {-remaining:,} bytes of its {count:,} {shown(name)} rows are "
                    "missing. Copy the file again."
                )
            elements[name] = np.frombuffer(file.read(count * dtype.itemsize), dtype)
    return PlyTable(comments, elements)


def write(path: Path, elements: dict[str, np.ndarray], comments: tuple[str, ...]) -> None:
    """Writes structured arrays as little-endian elements. A crash leaves the old file unchanged."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    for element, rows in elements.items():
        header.append(f"element {element} {len(rows)}")
        columns = (rows.dtype.fields or {}).items()
        header += [f"property {NAMES[column[0].str[1:]]} {name}" for name, column in columns]
    body = (rows.tobytes() for rows in elements.values())
    write_whole(path, b"".join(["\n".join([*header, "end_header", ""]).encode(), *body]))


def _header_of(path: Path, beginning: bytes) -> tuple[list[str], int]:
    if not beginning.startswith((b"ply\n", b"ply\r")):
        raise FormatError(f"{path}: not a PLY file. Give a splat file, such as the scene.ply of a run.")
    marker = beginning.find(b"end_header")
    end = beginning.find(b"\n", marker)
    if marker < 0 or end < 0:
        raise FormatError(f"{path}: truncated: its header has no end. Copy the file again.")
    return beginning[:marker].decode("latin-1").splitlines()[1:], end + 1


def _parse(path: Path, lines: list[str]):
    """Returns (form, comments, [(element, count, {property: type}, or None if it has lists)])."""
    form = ""
    comments: list[str] = []
    layout: list[tuple[str, int, dict[str, str] | None]] = []
    for line in lines:
        match line.split():
            case ["format", form, _]:
                pass
            case ["comment", *words]:
                comments.append(" ".join(words))
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                layout.append((name, int(count), {}))
            case ["property", "list", *_] if layout:
                layout[-1] = (layout[-1][0], layout[-1][1], None)
            case ["property", kind, name] if layout and kind in TYPES:
                if (fields := layout[-1][2]) is not None:
                    if name in fields:
                        raise FormatError(f"{path}: not a valid PLY header: two properties {shown(name)}.")
                    fields[name] = TYPES[kind]
            case [] | ["obj_info", *_]:
                pass
            case _:
                raise FormatError(f"{path}: not a valid PLY header: {shown(line)}.")
    if form not in ENDIANNESS:
        raise FormatError(f"{path}: PLY format {shown(form)} is unknown: expected {', '.join(ENDIANNESS)}.")
    return form, tuple(comments), layout


def _read_text(path: Path, file, name: str, count: int, dtype: np.dtype) -> np.ndarray:
    with blamed_on(path, f"its {shown(name)} rows cannot be read", "Get the file again.", FormatError):
        rows = np.loadtxt(file, dtype, max_rows=count, ndmin=1) if count else np.zeros(0, dtype)
    if len(rows) < count:
        raise FormatError(f"{path}: truncated: {len(rows):,} of its {count:,} {shown(name)} rows are there.")
    return rows
