"""Options of fixed choices that may be left out, such as --recipe."""

from types import NoneType, UnionType
from typing import Literal, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

OPTIONAL_CHOICES = ConstructorRegistry()


@OPTIONAL_CHOICES.primitive_rule
def optional_choice(option: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Returns how `Literal[...] | None` is read and shown; None for other types.

    Tyro's own rule lists None among the choices when it refuses another, and lists them in any order.
    """
    kinds = [kind for kind in get_args(option.type) if kind is not NoneType]
    if option.type_origin not in (Union, UnionType) or [*map(get_origin, kinds)] != [Literal]:
        return None
    values = get_args(kinds[0])
    words = tuple(map(str, values))
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(words)}}}",
        instance_from_str=lambda given: values[words.index(given[0])],
        is_instance=lambda value: value is None or value in values,
        str_from_instance=lambda value: [str(value)],
        choices=words,
    )
