"""Variants of a product: groups of options that show parts and map their colours."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from splatax.scene.colors import ColorMap
from splatax.scene.parts import Scene


@dataclass(frozen=True)
class Option:
    """One option of a variant, such as the paint "red".

    Attributes:
        shows: parts that are visible only while an option of the variant that shows them is chosen.
        colors: maps of the colours of parts, which replace the parts' own.
    """

    shows: tuple[str, ...] = ()
    colors: Mapping[str, ColorMap] = field(default_factory=dict)


Variants = Mapping[str, Mapping[str, Option]]  # by variant and option; the first option is the default


def check_variants(scene: Scene, variants: Variants) -> None:
    """Checks that variants fit a scene.

    Raises:
        ValueError: if a variant has no options or names a part that the scene has not, or if two variants map
            the colours of one part.
    """
    colored: dict[str, str] = {}
    for variant, options in variants.items():
        if not options:
            raise ValueError(f"variant {variant!r} has no options.")
        for name, option in options.items():
            for part in (*option.shows, *option.colors):
                if part not in scene.parts:
                    raise ValueError(
                        f"option {name!r} of variant {variant!r} names part {part!r}, but the scene has "
                        f"{', '.join(scene.names)}."
                    )
            for part in option.colors:
                if colored.setdefault(part, variant) != variant:
                    raise ValueError(
                        f"variants {colored[part]!r} and {variant!r} both colour part {part!r}. "
                        "Let one do it."
                    )


def chosen(scene: Scene, variants: Variants, choice: Mapping[str, str] | None = None) -> Scene:
    """Returns a scene with one option of each variant.

    A part that a variant shows is hidden unless the chosen options show it; other parts stay as they are.

    Args:
        scene: the scene, in which all parts are as without variants.
        variants: the options to choose from.
        choice: option of each variant; the first option of those that are not named.

    Raises:
        ValueError: if the variants do not fit the scene, or there is no variant or option of a name.
    """
    check_variants(scene, variants)
    choice = choice or {}
    for variant in choice:
        if variant not in variants:
            raise ValueError(f"no variant {variant!r}: choose from {', '.join(variants) or 'none'}.")
    parts = dict(scene.parts)
    for variant, options in variants.items():
        name = choice.get(variant, next(iter(options)))
        if name not in options:
            raise ValueError(f"variant {variant!r} has no option {name!r}: choose from {', '.join(options)}.")
        managed = {part for option in options.values() for part in option.shows}
        for part in managed - set(options[name].shows):
            parts[part] = replace(parts[part], visible=False)
        for part, color in options[name].colors.items():
            parts[part] = replace(parts[part], color=color)
    return Scene(parts)
