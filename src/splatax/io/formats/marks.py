"""Comments in scene files that say whether a scene was trained with antialiasing."""

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"


def mark(antialiased: bool) -> str:
    """Returns the comment that marks a scene."""
    return MIP if antialiased else PLAIN
