"""Comments in scene files that say whether a scene was trained with antialiasing."""

from splatax.low_pass import Antialiasing, LowPass

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"
MARKS = (MIP, PLAIN)


def mark(low_pass: LowPass) -> str:
    """Returns the comment that names the filter of a scene."""
    return MIP if isinstance(low_pass, Antialiasing) else PLAIN
