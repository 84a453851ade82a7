"""The comment that tells how a scene is to be drawn."""

MIP = "SplatRenderMode: mip"  # it was trained with antialiasing
PLAIN = "SplatRenderMode: default"


def mark(antialiased: bool) -> str:
    """The comment for a scene."""
    return MIP if antialiased else PLAIN
