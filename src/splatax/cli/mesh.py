"""`splatax mesh`: a triangle mesh of a scene."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track

import splatax as sx
from splatax import mesh
from splatax.cli.depths import DepthName, chosen_depth
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    DownscaleOption,
    LowPassOption,
    OrderOption,
    OverwriteFlag,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    scene_of,
    shown_as,
)
from splatax.cli.output import say
from splatax.errors import InputError
from splatax.geometry_scores import DEPTH
from splatax.mesh.extraction import check
from splatax.mesh.files import suffix_of


@dataclass(frozen=True)
class Mesh:
    """Make a triangle mesh of the surfaces that the training cameras see.

    Fuses the depth of the scene from all training cameras. The mesh has colours, and ends where fewer than
    three cameras saw a surface; small disconnected pieces are removed. Train the scene with --geometry for
    better meshes; see docs/mesh.md.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The file to write: .ply, .glb (y up) or .obj."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture. By default the one that the run was trained on."""
    voxel: Annotated[Literal["auto"] | float, shown_as("{auto,LENGTH}")] = "auto"
    """Width of a voxel in world units: smaller details are lost. "auto", the default: the median width of a
    pixel on the surface or, if it is larger, the median difference between the depths that neighbouring
    cameras see."""
    depth: Annotated[DepthName, shown_as()] = "auto"
    """Depth output of the scene to fuse. "auto", the default: the one that agrees best with the capture's
    own points, also on thin parts."""
    faces: Annotated[int | None, shown_as("N")] = None
    """Simplify to this many faces. By default all are kept; with --collision, 5000."""
    collision: Annotated[bool, shown_as()] = False
    """Make a small mesh for physics instead, which encloses up to three voxels behind each surface that is
    seen. With --voxel auto, voxels are twice as wide."""
    downscale: DownscaleOption = None
    """Divide the width and height of the rendered depth by this number. "auto": the smallest factor that
    brings the long side down to 1600 pixels. By default as in training, else "auto"."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        suffix_of(self.out)
        voxel = None if self.voxel == "auto" else self.voxel
        check(voxel, self.faces)
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        model = read_model(self.model, self.low_pass, self.order)
        scene = self.scene or scene_of(model)
        if scene is None:
            raise InputError(f"{self.model}: needs cameras: give the capture folder, --scene CAPTURE.")
        train = load_scene(scene, self.downscale, model).train
        background = background_of(model.options, self.background)
        renderer = sx.Renderer(background, backend=resolve_backend(self.backend))
        depth = chosen_depth(self.depth, model.gaussians, train, renderer, otherwise=DEPTH)
        cameras = [view.camera for view in train]
        views = mesh.depth_views(model.gaussians, cameras, renderer=renderer, depth=depth)
        if voxel is None:
            voxel = self._chosen(views)
        if self.collision:
            found = mesh.collision_mesh(views, voxel, faces=self.faces or mesh.COLLISION_FACES, watch=watched)
        else:
            found = mesh.extract(views, voxel, faces=self.faces, watch=watched)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        mesh.save(self.out, found)
        size = self.out.stat().st_size / 1e6
        say(f"{self.out}: {len(found.vertices):,} vertices, {len(found.faces):,} faces, {size:.2f} MB")
        if self.faces and len(found.faces) > self.faces:
            say(f"more than the {self.faces:,} faces asked for: fewer would move the borders of the surface")

    def _chosen(self, views: tuple[mesh.DepthView, ...]) -> float:
        """Returns the width of a voxel that suits the views. Prints what it follows from."""
        resolution = mesh.resolution_of(views)
        voxel = resolution.voxel * (mesh.COLLISION_COARSER if self.collision else 1)
        say(
            f"voxels of {voxel:.4g}: a pixel is {resolution.pixel:.4g} wide, and depths of neighbouring "
            f"cameras differ by {resolution.noise:.4g} (medians)"
        )
        return voxel


def watched(items: Sequence[Any], activity: str) -> Iterable[Any]:
    """Returns the items. Shows a bar with the time that remains on a terminal, and a line elsewhere."""
    if not Console().is_terminal:
        say(f"{activity} ...")
        return items
    return track(items, activity, transient=True)
