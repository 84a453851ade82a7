"""The options of `splatax train` in groups, with their help. None stands for an option that is not given."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatax.cli.options import (
    AdjustmentName,
    AppearanceName,
    BackendName,
    BackgroundName,
    Downscale,
    HoldOutOption,
    InitName,
    LowPassOption,
    OrderOption,
    PhotoWeightsName,
    RecipeName,
    RefinementName,
    shown_as,
)
from splatax.viewer.server import LOCAL, PORT

Count = Annotated[int | None, shown_as("N")]


@dataclass(frozen=True)
class Rerun:
    """Runs that were made before. All other options are those of the earlier run."""

    resume: Annotated[Path | None, shown_as("RUN")] = None
    """Resume an interrupted run, given its folder or one of its checkpoint files."""
    repeat: Annotated[Path | None, shown_as("RUN")] = None
    """Repeat a finished run exactly, with the same options and the same number of steps, in another
    folder."""


@dataclass(frozen=True)
class Photos:
    """Photos and points to train on."""

    hold_out: HoldOutOption = None
    """Photos to score the scene on instead of training on them. "every:8": every 8th by name, from the middle
    of the first 8 ("every:8:1": from the 1st); "last" or "last:N": the last; LIST: names with commas, or a
    .txt file with one a line; "none". By default those that the capture lists, else "every:8", which never
    holds out the first or the last; for create none, except in its trial run."""
    leave_out: Annotated[str | None, shown_as("{auto,none,LIST}")] = None
    """Photos not to train on. "auto", the default: those that are blurred compared with the rest, and those
    that repeat another; LIST: names with commas, or a .txt file."""
    undistort: Annotated[bool, shown_as()] = False
    """Resample the photos for pinhole cameras before training. By default photos are used as they are, and
    the scene is trained through their lenses. Photos of a lens that splatax lacks are always resampled."""
    points: Annotated[Path | None, shown_as("FILE.ply")] = None
    """Start from the coloured points of this file instead of those of the capture."""
    judged_by: Annotated[Path | None, shown_as("RUN")] = None
    """Quote the scores of another run of this capture in the report, for a run that holds out no photos."""
    photo_weights: Annotated[PhotoWeightsName | None, shown_as()] = None
    """Weights of photos in training. "robust": photos whose loss stays far above that of the others after a
    third of the run get a lower weight, because their pose is wrong or they show something else; "equal": all
    photos have the same weight. By default "auto": robust for the recipe "default" from 10 training photos
    on, else equal."""


@dataclass(frozen=True)
class Limits:
    """Time, memory and size."""

    budget: Annotated[str | None, shown_as("TIME")] = None
    """Training time limit, for example 30s, 5min or 1h. Steps and Gaussians are chosen to fit by the measured
    speed of this machine. The run ends after 500 steps for each photo at the latest, and can be repeated
    exactly with --repeat. By default 6min, for create 10min, unless --steps or another --recipe is given."""
    within: Annotated[str | None, shown_as("TIME")] = None
    """Time limit of the whole command, for example 10min, instead of --budget: loading, planning and writing
    the results count too."""
    memory: Annotated[str | None, shown_as("SIZE")] = None
    """Limit the memory of the whole process, for example 4GB. Caps the number of Gaussians, and keeps decoded
    photos that do not fit on disk (see splatax cache). By default decoded photos may take half of the
    machine's memory."""
    steps: Count = None
    """Number of training steps; each step uses one photo, or --views photos. By default as many as
    --budget has time for; for other recipes than "default" 30,000, or 30 for each training photo if that is
    more. With --views, a part of that, so that the photos of all steps together are as many."""
    max_gaussians: Annotated[Literal["auto"] | int | None, shown_as("{auto,N}")] = None
    """Upper limit of the number of Gaussians. "classic" and "absgrad" rarely reach it; the other recipes
    always do. A scene that starts with more, one for each point, does not grow. By default "auto": as
    many as the photos have detail for, or 5,000,000 for "classic" and "absgrad"."""
    downscale: Annotated[Downscale | None, shown_as("{auto,N}")] = None
    """Divide the width and height of photos by this number. By default "auto": the smallest factor that
    brings the long side down to 1600 pixels."""


@dataclass(frozen=True)
class Devices:
    """Several photos in each step, on several devices and hosts. See docs/scale.md."""

    views: Count = None
    """Number of photos in each step (batch size). They are divided among all devices that JAX finds; the
    scene depends on this number, not on the number of devices. It excludes --budget and --within, which plan
    steps by the measured speed of one photo in each step. By default 1."""
    hosts: Annotated[str | None, shown_as("{auto,ADDRESS:PORT,COUNT,INDEX}")] = None
    """Train together with other processes, which run the same command; needs --views. "auto": as JAX finds
    them (SLURM, Open MPI, Kubernetes, TPU pods); else the address of process 0, the number of processes, and
    the index of this one, from 0. Process 0 decides, and writes the results. Checkpoints are saved every
    --checkpoint-steps steps, by default every 500; --checkpoint-every is refused. Ctrl-C and SIGTERM end the
    run without saving it. It excludes --view. splatax create runs in one process and refuses this option."""


@dataclass(frozen=True)
class Method:
    """Training method."""

    recipe: Annotated[RecipeName | None, shown_as()] = None
    """Preset of all training settings. "classic": Kerbl et al. 2023; "absgrad": Ye et al. 2024; "mcmc":
    Kheradmand et al. 2024; "2dgs": Huang et al. 2024; "default", the default: the best known results."""
    init: Annotated[InitName | None, shown_as()] = None
    """Initialize from the capture's points ("sfm", the default), or randomly inside the camera frusta. If a
    capture has no points, "sfm" finds some in the photos, and starts randomly only if that fails."""
    sky: Annotated[bool, shown_as()] = False
    """Start with additional Gaussians on a sphere far behind the scene. Use it for open scenes: captures
    rarely have points in the sky. Off by default."""
    appearance: Annotated[AppearanceName | None, shown_as()] = None
    """Compensate for differences between photos. "exposure": learns an affine colour map for each training
    photo, for exposure and white balance. By default "auto": only if exposure differs much. Held-out photos
    are compared as they are, and once more after a colour correction."""
    refine: Annotated[RefinementName | None, shown_as()] = None
    """Optimize the training cameras: their poses, focal lengths, lenses (focal lengths and distortion), or
    motion during the exposure (a rolling shutter). Use it only for what is inaccurate by a pixel or less;
    for larger errors of poses and lenses use --adjust-cameras. Writes the cameras to refined/sparse/0.
    Cameras of held-out photos stay as given. By default none."""
    adjust_cameras: Annotated[AdjustmentName | None, shown_as()] = None
    """Adjust the cameras of training photos to matched features before training (bundle adjustment): their
    poses; also focal lengths with "poses+focal", distortion with "poses+distortion", or both with
    "poses+lens". The given cameras are kept if that does not lower the reprojection error of held-out
    points. Held-out photos are not used for it and keep their poses, but get the lenses found for training
    photos; they are also scored with poses adjusted to them. By default none."""
    geometry: Annotated[bool, shown_as()] = False
    """Make the Gaussians lie on surfaces, for accurate depth, normals and meshes. Adds penalties on the
    spread of depth along each ray, on normals that differ from those of the depth image, and on depths that
    differ from those of the capture's own points or depth maps. A step takes 2 to 3.4 times as long, and PSNR
    is 0 to 0.5 dB lower. With the recipe 2dgs they replace its own penalties. By default off."""
    geometry_after: Annotated[float | None, shown_as("FRACTION")] = None
    """Fraction of the run after which the penalties of --geometry begin. A later start costs less PSNR, and
    makes depths and normals less accurate. By default 0.3."""
    seed: Count = None
    """Random seed. Runs with the same seed, machine and options produce identical scenes. By default 0."""


@dataclass(frozen=True)
class Drawing:
    """Drawing of the scene, in training and afterwards."""

    background: Annotated[BackgroundName | None, shown_as()] = None
    """Colour behind the scene and behind transparent photos. "random": a new colour every step, which
    prevents haze; evaluation uses black. By default white for Blender's scenes, random for the recipe
    "default", else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. "dilation": as in 3DGS; "antialiasing": as in Mip-Splatting, keeps the brightness
    correct when zoomed out; "along-rays": exact in perspective, as in 2DGS. A number after a colon is its
    variance in square pixels. By default "along-rays" for the recipe "2dgs", else "dilation"."""
    order: OrderOption = None
    """Order in which splats are drawn. "distance": from the camera, which keeps large Gaussians beside the
    picture from covering it; some steps draw by depth, so that viewers that know only that order can show the
    scene. "depth": as in 3DGS. By default "distance" for the recipe "default", else "depth"."""
    backend: Annotated[BackendName | None, shown_as()] = None
    """Rendering backend. If the named one is unavailable, the command fails instead of falling back. By
    default "auto": the fastest one available."""


@dataclass(frozen=True)
class Saving:
    """Evaluation and checkpoints during training."""

    eval_every: Count = None
    """Steps between evaluations of the held-out photos. By default 0: only at the end."""
    checkpoint_every: Annotated[float | None, shown_as("SECONDS")] = None
    """Seconds between checkpoints. The last two are kept until the run has finished. By default 120; 0: only
    when the run is interrupted, and at its end. It excludes --hosts, which saves by steps."""
    checkpoint_steps: Count = None
    """Additionally save a checkpoint every N steps. By default 0: off; with --hosts, 500."""


@dataclass(frozen=True)
class Live:
    """The live viewer."""

    view: Annotated[bool, shown_as()] = False
    """Show the scene in the browser while it trains. It excludes --hosts."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = LOCAL[0]
    """Address to listen on. The default accepts connections from this machine only; 0.0.0.0 accepts
    connections from the network."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = PORT
    """Port of the live viewer; if it is taken, the next free one is used."""
