"""A scene inside a notebook, where the result of a cell is shown."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np
from jaxtyping import Array, Float

from splatax.dataset import View
from splatax.gaussians import Gaussians
from splatax.projection import Dilation, LowPass
from splatax.rendering import BLACK


@dataclass(frozen=True)
class Inline:
    """What notebooks show in place of text: a page in a frame of its own, which asks the network for nothing.

    Attributes:
        title: of the page.
        page: its HTML.
        height: of the frame, CSS pixels.
    """

    title: str
    page: str = field(repr=False)
    height: int = 480

    def _repr_html_(self) -> str:
        """The frame. IPython's protocol, which Jupyter, VS Code and Colab share."""
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.page)}" width="100%" '
            f'height="{self.height}" style="border: 0" allow="fullscreen"></iframe>'
        )


def view(
    gaussians: Gaussians,
    views: Iterable[View] = (),
    *,
    title: str = "scene",
    background: Float[Array, "3"] | Float[np.ndarray, "3"] = BLACK,
    low_pass: LowPass = Dilation(),
    height: int = 480,
) -> Inline:
    """Shows a scene in a notebook, as the last line of a cell: it can be turned, also in the saved file.

    Args:
        gaussians: the scene, with SH up to degree 3.
        views: of the capture, such as `dataset.views`: their cameras become places to look from.
        title: any text.
        background: display-referred RGB behind the scene, in [0, 1].
        low_pass: as the scene was trained.
        height: of the frame, CSS pixels; it is as wide as the notebook.

    Raises:
        InputError: if the viewer has not been built.
        FormatError: if the scene is empty, or has harmonics that the viewer cannot draw.
    """
    from splatax import web  # here, so that `import splatax` does without it

    cameras = {view.name: view.camera for view in views}
    red, green, blue = (float(value) for value in background)
    page = web.document(
        gaussians,
        title=title,
        cameras=cameras,
        background=(red, green, blue),
        low_pass=low_pass,
        name=title,
    )
    return Inline(title, page, height)
