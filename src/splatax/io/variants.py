"""Variants and maps of colours as JSON values, as .glb files keep them."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from splatax.scene import ColorMap, Option, Variants


def listed(variants: Variants) -> list[dict[str, Any]]:
    """Returns variants as JSON values."""
    return [
        {
            "name": variant,
            "options": [
                {
                    "name": name,
                    "shows": list(option.shows),
                    "colors": {part: rows_of(color) for part, color in option.colors.items()},
                }
                for name, option in options.items()
            ],
        }
        for variant, options in variants.items()
    ]


def variants_of(values: Iterable[Mapping[str, Any]]) -> Variants:
    """Returns the variants that JSON values describe; the inverse of `listed`."""
    return {
        str(variant["name"]): {
            str(option["name"]): Option(
                tuple(map(str, option["shows"])),
                {str(part): map_of(rows) for part, rows in option["colors"].items()},
            )
            for option in variant["options"]
        }
        for variant in values
    }


def map_of(rows: Any) -> ColorMap:
    """Returns a map of colours from the rows of its matrix, each with its offset at the end."""
    numbers = np.array(rows, np.float32).reshape(3, 4)
    if not np.isfinite(numbers).all():
        raise ValueError("a map of colours is not finite")
    return ColorMap(numbers[:, :3], numbers[:, 3])


def rows_of(color: ColorMap | None) -> list[list[float]] | None:
    """Returns the rows of the matrix of a map of colours, each with its offset; None for no map."""
    if color is None:
        return None
    return np.column_stack([np.asarray(color.matrix), np.asarray(color.offset)]).tolist()
