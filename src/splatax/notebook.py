"""Display of a scene as the result of a notebook cell."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

from splatax.dataset import View
from splatax.gaussians import Gaussians
from splatax.rendering import BLACK, Color


@dataclass(frozen=True)
class Inline:
    """An HTML page that notebooks show in an iframe. It makes no network requests.

    Attributes:
        title: title of the page.
        page: HTML of the page.
        height: height of the iframe, CSS pixels.
    """

    title: str
    page: str = field(repr=False)
    height: int = 480

    def _repr_html_(self) -> str:
        """Returns the iframe. This is IPython's display protocol, which Jupyter, VS Code and Colab share."""
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.page)}" width="100%" '
            f'height="{self.height}" style="border: 0" allow="fullscreen"></iframe>'
        )


def view(
    gaussians: Gaussians,
    views: Iterable[View] = (),
    *,
    title: str = "scene",
    background: Color = BLACK,
    height: int = 480,
) -> Inline:
    """Shows a scene in a notebook, as the last line of a cell. It stays interactive in the saved notebook.

    Args:
        gaussians: the scene, with SH up to degree 3.
        views: views whose cameras become viewpoints, such as `dataset.views`.
        title: any text.
        background: display-referred RGB behind the scene, in [0, 1].
        height: height of the iframe, CSS pixels; it is as wide as the notebook.

    Raises:
        InputError: if the viewer has not been built.
        FormatError: if the scene is empty, or its SH degree is above 3.
    """
    from splatax import web  # here, so that `import splatax` does not load it

    cameras = {view.name: view.camera for view in views}
    page = web.document(
        gaussians,
        title=title,
        cameras=cameras,
        background=background,
        name=title,
    )
    return Inline(title, page, height)
