"""`Scene`: named parts, each with Gaussians, a pose, a visibility and a map of its colours."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax import gaussians as clouds
from splatax.gaussians import Gaussians
from splatax.pytrees import pytree
from splatax.scene.colors import ColorMap
from splatax.shapes import check_kind
from splatax.transforms import Similarity

IDENTITY = Similarity(np.eye(3), np.zeros(3))


@pytree
@dataclass(frozen=True)
class Part:
    """One part of a scene. All fields are traced.

    Attributes:
        gaussians: in the part's own coordinates.
        pose: transform from the part to the world.
        visible: 1 to draw the part, 0 to hide it. True and False are taken too. A hidden part is not drawn
            and has a zero gradient.
        color: map of its colours; None to keep them.
    """

    gaussians: Gaussians
    pose: Similarity = IDENTITY
    visible: float | Float[Array, ""] = 1.0
    color: ColorMap | None = None

    def __post_init__(self) -> None:
        if isinstance(self.visible, bool | np.bool_):  # gradients need numbers
            object.__setattr__(self, "visible", float(self.visible))

    def in_world(self) -> Gaussians:
        """Returns the Gaussians as the world has them: coloured and placed, whether visible or not."""
        colored = self.gaussians if self.color is None else self.color.transform(self.gaussians)
        return self.pose.transform(colored)


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Scene:
    """A scene of named parts, which `render` draws like Gaussians.

    It is a pytree. Poses, visibilities, colours and Gaussians are traced, so a program that poses and renders
    a scene compiles once, and has gradients to all of them. Rows of the scene are those of its parts, one
    part after another: `features` and `contributors` use them.

    Attributes:
        parts: the parts by name, at least one. Their order is kept.
    """

    parts: Mapping[str, Part]

    def __post_init__(self) -> None:
        check_kind("parts", self.parts, Mapping, "Give them by name, such as {'car': Part(gaussians)}.")
        if not self.parts:
            raise ValueError("a scene without parts. Give at least one, such as {'car': Part(gaussians)}.")
        for name, part in self.parts.items():
            check_kind(f"the name {name!r} of a part", name, str, "Give a text.")
            check_kind(f"part {name!r}", part, Part, "Give Part(gaussians), with a pose if it has one.")
        object.__setattr__(self, "parts", dict(self.parts))

    def tree_flatten_with_keys(self):
        """Returns the parts by name, for JAX, in their order."""
        return [(jax.tree_util.GetAttrKey(name), part) for name, part in self.parts.items()], self.names

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], parts: Iterable[Any]) -> "Scene":
        """Returns the scene with other parts, which JAX may replace by placeholders."""
        made = object.__new__(cls)
        object.__setattr__(made, "parts", dict(zip(names, parts, strict=True)))
        return made

    def __len__(self) -> int:
        """Returns the number of Gaussians of all parts."""
        return sum(len(part.gaussians) for part in self.parts.values())

    def __getitem__(self, name: str) -> Part:
        """Returns a part.

        Raises:
            ValueError: if there is no part of this name.
        """
        if name not in self.parts:
            raise ValueError(f"no part {name!r}: the scene has {', '.join(self.names)}.")
        return self.parts[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts, in their order."""
        return tuple(self.parts)

    def posed(self, poses: Mapping[str, Similarity]) -> "Scene":
        """Returns the scene with other poses of some parts.

        Raises:
            ValueError: if there is no part of a name.
        """
        return self.replaced({name: replace(self[name], pose=pose) for name, pose in poses.items()})

    def shown(self, visible: Mapping[str, bool | float | Float[Array, ""]]) -> "Scene":
        """Returns the scene with some parts shown (True) or hidden (False).

        Raises:
            ValueError: if there is no part of a name.
        """
        return self.replaced({name: replace(self[name], visible=on) for name, on in visible.items()})

    def colored(self, colors: Mapping[str, ColorMap | None]) -> "Scene":
        """Returns the scene with other colour maps of some parts.

        Raises:
            ValueError: if there is no part of a name.
        """
        return self.replaced({name: replace(self[name], color=color) for name, color in colors.items()})

    def replaced(self, parts: Mapping[str, Part]) -> "Scene":
        """Returns the scene with other parts under some of its names.

        Raises:
            ValueError: if there is no part of a name.
        """
        for name in parts:
            self[name]
        return Scene({**self.parts, **parts})

    def part_of(self, rows: Int[Array, "*shape"]) -> tuple[Int[Array, "*shape"], Int[Array, "*shape"]]:
        """Returns the part of each row of the scene, by its number, and the row within the part.

        A row of -1, which `contributors` has where no Gaussian is drawn, gives -1 twice.
        """
        sizes = [len(part.gaussians) for part in self.parts.values()]
        starts = jnp.asarray(np.cumsum([0, *sizes[:-1]]), rows.dtype)
        part = jnp.searchsorted(starts, rows, side="right").astype(rows.dtype) - 1
        # Parts without Gaussians start where the next one does; `side` skips them.
        within = rows - starts[jnp.maximum(part, 0)]
        return jnp.where(rows < 0, -1, part), jnp.where(rows < 0, -1, within)

    def flattened(self) -> Gaussians:
        """Returns the visible parts as one set of Gaussians, for programs and files that know no parts.

        Hidden parts are left out. Under `jit`, where visibility is not known, they become empty slots.

        Raises:
            ValueError: if no part is visible, or parts were trained with different low-pass filters.
        """
        shown = []
        for part in self.parts.values():
            known = not isinstance(part.visible, jax.core.Tracer)
            if not (known and part.visible <= 0):
                placed = part.in_world()
                shown.append(placed if known else masked(placed, part.visible))
        if not shown:
            raise ValueError(f"no part of the scene is visible: {', '.join(self.names)} are hidden.")
        if len({part.low_pass for part in shown}) > 1:
            raise ValueError(
                "the parts cannot be merged: they were trained with different low-pass filters. Render the "
                "scene of parts instead, or train them alike."
            )
        return clouds.joined(shown)


def masked(gaussians: Gaussians, visible: float | Float[Array, ""]) -> Gaussians:
    """Returns the Gaussians if visible, else as many empty slots."""
    logits = gaussians.opacity_logits
    return replace(gaussians, opacity_logits=jnp.where(jnp.asarray(visible) > 0, logits, -jnp.inf))
