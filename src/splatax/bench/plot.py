"""Plot of time over the size of the scene, for each operation and backend."""

import io
from collections import defaultdict
from typing import Any

import numpy as np

STYLES = ("-", "--", ":", "-.")  # one for each backend


def plot(results: list[dict[str, Any]]) -> bytes:
    """Plots median times over the number of visible Gaussians, with one panel for each image size.

    Procedural scenes are joined by lines; other scenes are crosses.

    Args:
        results: the results in bench.json, one for each scene and image size.

    Returns:
        The plot as a PNG file.
    """
    from matplotlib.figure import Figure  # slow to import

    sizes = list(dict.fromkeys((result["width"], result["height"]) for result in results))
    figure = Figure(figsize=(6.5 * len(sizes), 5), layout="constrained")
    panels = figure.subplots(1, len(sizes), squeeze=False)[0]
    names = list(dict.fromkeys(row["operation"] for result in results for row in result["operations"]))
    backends = list(dict.fromkeys(row["backend"] for result in results for row in result["operations"]))
    for panel, size in zip(panels, sizes, strict=True):
        lines = defaultdict(list)
        for result in results:
            if (result["width"], result["height"]) == size:
                # Procedural scenes make a line; any other scene is a point by itself.
                family = "" if result["procedural"] else result["scene"]
                for row in result["operations"]:
                    key = row["operation"], row["backend"], family
                    lines[key].append((result["visible"], row["median"]))
        labelled = set()
        for (name, backend, family), points in lines.items():
            label = f"{name}, {backend}"
            panel.loglog(
                *np.array(sorted(points)).T,
                STYLES[backends.index(backend) % len(STYLES)],
                marker="x" if family else "o",
                markersize=4,
                color=f"C{names.index(name)}",
                label=None if label in labelled else label,
            )
            labelled.add(label)
        panel.set(title=f"{size[0]} x {size[1]}", xlabel="visible Gaussians", ylabel="milliseconds")
        panel.grid(alpha=0.3, which="both")
    panels[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
