"""The depth output that `splatax mesh` and `splatax render` use, as asked for or chosen by the capture."""

from collections.abc import Sequence
from typing import Literal

import splatax as sx
from splatax.cli.output import say
from splatax.geometry_scores import DEPTHS, best_depth

DepthName = Literal["auto", *DEPTHS]  # type: ignore[valid-type]


def chosen_depth(
    asked: DepthName,
    gaussians: sx.Gaussians,
    views: Sequence[sx.View],
    renderer: sx.Renderer,
    otherwise: str,
) -> str:
    """Returns the name of the depth output to use. Prints it and, for "auto", why it was chosen.

    Args:
        asked: name of an output, or "auto" for the one that agrees best with the landmarks of the views.
        gaussians: the scene.
        views: training views; none if there is no capture.
        renderer: with the low-pass filter that the scene was trained with.
        otherwise: the output that "auto" takes if the views have no landmarks.
    """
    if asked != "auto":
        say(f"depth   {asked}")
        return asked
    if best := best_depth(gaussians, views, renderer):
        say(f"depth   {best}: agrees best with the known points of the training photos")
        return best
    lacking = "no training photo has known points" if views else "there is no capture with known points"
    say(f"depth   {otherwise}: the default, because {lacking} to compare depths with")
    return otherwise
