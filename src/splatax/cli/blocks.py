"""`splatax blocks`: a capture that is too large for one run, in blocks that are trained one by one."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.table import Table

import splatax as sx
from splatax.blocks.jobs import jobs
from splatax.blocks.merging import is_finished, is_of_plan, merged
from splatax.blocks.plan import PLAN, Plan, check_number, folder_of, read_plan, write_plan
from splatax.blocks.planning import Work, made_plan, thinned
from splatax.cli.continuation import as_before, carry_on
from splatax.cli.failures import advice
from splatax.cli.options import Downscale, OverwriteFlag, flag, given, read_model, shown_as
from splatax.cli.output import say, show
from splatax.cli.page import tell_losses
from splatax.cli.planning import with_default_steps
from splatax.cli.preparing import loaded, prepared
from splatax.cli.settings import NAMES, Settings
from splatax.cli.stages import Stages
from splatax.cli.starting import with_background
from splatax.cli.train_options import Count, Drawing, Method, Photos
from splatax.dataset import Dataset
from splatax.errors import InputError
from splatax.io.datasets.points import write_points
from splatax.io.formats import format_of
from splatax.runs.claim import claimed
from splatax.runs.finished import finished
from splatax.runs.records import typed_fields, understood

CityPath = Annotated[Path, tyro.conf.Positional, shown_as("CITY")]
COARSE = "coarse"  # folder of its run, in that of the plan
POINTS = "coarse-points.ply"  # those that it starts from, if the capture has too many
LOOKING = "photos of each block"
OWN = ("memory", "checkpoint_every", "checkpoint_steps")  # options that each block has for itself


@dataclass(frozen=True)
class PlanBlocks:
    """Divide a capture into blocks, from a coarse scene of all of it.

    Writes the plan to CITY/blocks.json, the coarse run to CITY/coarse, and prints the commands that train the
    blocks. They are not executed.
    """

    scene: Annotated[Path, tyro.conf.Positional, shown_as("CAPTURE")]
    """Folder of the capture, or a zip file of it, as for splatax train."""
    out: Annotated[Path, tyro.conf.arg(metavar="CITY")] = field(kw_only=True)
    """Folder of the plan, and of the runs of its blocks."""
    blocks: Annotated[int | None, shown_as("N")] = None
    """Number of blocks."""
    gaussians_per_block: Annotated[int | None, shown_as("N")] = None
    """Choose the number of blocks so that each has about this many Gaussians, instead of --blocks. A block
    also trains those in a margin around it."""
    steps: Count = None
    """Number of steps that one run of the whole capture would make. A block that half of the photos show
    makes half as many. By default 30,000, or 30 for each training photo if that is more."""
    max_gaussians: Annotated[Literal["auto"] | int | None, shown_as("{auto,N}")] = None
    """Number of Gaussians of all blocks together. By default "auto", as for splatax train."""
    downscale: Annotated[Downscale | None, shown_as("{auto,N}")] = None
    """Divide the width and height of photos by this number. By default as for splatax train."""
    coarse: Annotated[Path | None, shown_as("MODEL")] = None
    """Coarse scene of the whole capture: a splat file, or the folder of a run. By default a run with a
    quarter of the Gaussians, but not more than a block has, and a fifth of the steps, but at least 2,000, or
    all if there are fewer."""
    photos: Photos = Photos()
    method: Method = Method()
    drawing: Drawing = Drawing()
    overwrite: OverwriteFlag = False
    """Replace an earlier plan in the folder. Blocks that were trained for it must be trained again."""

    def run(self) -> None:
        self.check()
        settings = self.settings()
        with claimed(self.out):
            if (self.out / PLAN).exists() and not self.overwrite:
                raise InputError(
                    f"{self.out / PLAN}: exists. Choose another folder, or replace the plan.",
                    options=("out", "overwrite"),
                )
            dataset = loaded(settings)
            for note in dataset.notes:
                say(note)
            settings, dataset = prepared(settings, dataset, self.out)
            settings = replace(with_background(settings, dataset), adjust_cameras="none")
            if self.steps is None:
                settings = with_default_steps(settings, dataset)
            work = Work(settings.most(dataset), settings.steps)
            blocks = self.blocks or -(-work.gaussians // (self.gaussians_per_block or 1))
            settings = replace(settings, max_gaussians=work.gaussians)
            path = self.coarse_scene(settings, work.coarse(blocks), dataset)
            with Stages([LOOKING]) as stages:
                plan, contexts = made_plan(
                    dataset,
                    (path, sx.load(path)),
                    blocks,
                    work,
                    asdict(settings),
                    lambda done, total: stages.show(LOOKING, done, total),
                )
            write_plan(self.out, plan, contexts)
        show(table_of(plan, len(dataset.train)))
        say(f"plan    {self.out / PLAN}")
        for line in jobs(self.out, len(plan.blocks)):
            say(line)

    def check(self) -> None:
        """Raises InputError if the options exclude each other or make no sense."""
        if (self.blocks is None) == (self.gaussians_per_block is None):
            raise InputError("Give the number of blocks, by either --blocks or --gaussians-per-block.")
        for name, least in (("blocks", 2), ("gaussians_per_block", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{flag(name)}: at least {least}, not {value}.")
        if self.method.refine not in (None, "none"):
            raise InputError(
                "--refine: each block would move the cameras in its own way. Use --adjust-cameras, which "
                "adjusts them once, or leave the option out."
            )
        if self.photos.judged_by:
            raise InputError("--judged-by: has no meaning for blocks. Leave it out.")

    def settings(self) -> Settings:
        """Returns the options of the runs, as given."""
        unshared = {"out", "overwrite"}
        chosen = {
            name: value for name, value in given(self).items() if name in NAMES and name not in unshared
        }
        settings = Settings(**chosen)
        settings.check()
        return settings.absolute()

    def coarse_scene(self, settings: Settings, work: Work, dataset: Dataset) -> Path:
        """Returns the file of the coarse scene, which is trained unless one is given.

        Args:
            settings: of the runs.
            work: size of the coarse run; it starts from no more points than it has Gaussians.
            dataset: the whole capture.

        Raises:
            InputError: if the run was interrupted.
        """
        if self.coarse:
            return read_model(self.coarse).path.absolute()
        out, points = self.out / COARSE, settings.points
        if len(dataset.points) > work.gaussians:
            points = self.out.absolute() / POINTS
            write_points(points, thinned(dataset.points, work.gaussians, settings.seed))
        own = replace(
            settings,
            out=out,
            steps=work.steps,
            max_gaussians=work.gaussians,
            points=points,
            title=f"{self.out.resolve().name}, coarse",
            overwrite=self.overwrite,
        )
        if is_finished(out) and not self.overwrite:  # by an earlier command that got no further
            as_before(own, finished(out, NAMES)[0])
        else:
            say(f"coarse scene: {work.gaussians:,} Gaussians, {work.steps:,} steps")
            carry_on(own, out)
        if not is_finished(out):
            raise InputError(
                f"{out}: the coarse run was stopped. Give the same command again to continue it."
            )
        return out / "scene.ply"


@dataclass(frozen=True)
class TrainBlock:
    """Train one block of a plan, or continue its run where it was stopped.

    The Gaussians around the block are those of the coarse scene: they are drawn, and do not change.
    Where they fill a photo, the block is compared with the coarse scene instead. The result is an ordinary
    run in CITY/block-NNN. A block that is trained to the end is left alone.
    """

    city: CityPath
    """Folder of the plan."""
    block: Annotated[int, tyro.conf.Positional, shown_as("BLOCK")]
    """Number of the block, from 0."""
    memory: Annotated[str | None, shown_as("SIZE")] = None
    """Limit the memory of the whole process, for example 4GB. Keeps decoded photos that do not fit on disk.
    The number of Gaussians is that of the plan: if the block and the fixed Gaussians around it do not fit,
    the command fails and prints the numbers. By default decoded photos may take half of the machine's
    memory."""
    checkpoint_every: Annotated[float | None, shown_as("SECONDS")] = None
    """Seconds between checkpoints, as for splatax train."""
    checkpoint_steps: Count = None
    """Additionally save a checkpoint every N steps."""
    overwrite: OverwriteFlag = False
    """Train the block again from its first step, even if its run is finished or was interrupted."""

    def run(self) -> None:
        plan = read_plan(self.city)
        check_number(plan, self.city, self.block)
        out = folder_of(self.city, self.block)
        if not self.overwrite and is_finished(out):
            if not is_of_plan(self.city, self.block):
                raise InputError(
                    f"{out}: trained for another plan. Train it again: --overwrite.", options=("overwrite",)
                )
            say(f"{out}: holds the finished run of the block")
            return
        with understood(self.city / PLAN, "Plan the blocks again."):
            settings = Settings(**typed_fields(Settings, plan.options))
        block = plan.blocks[self.block]
        own = {name: value for name, value in given(self).items() if name in OWN}
        settings = replace(
            settings,
            city=self.city.absolute(),
            block=self.block,
            out=out,
            steps=block.steps,
            max_gaussians=block.gaussians,
            title=f"{self.city.resolve().name}, block {self.block} of {len(plan.blocks)}",
            overwrite=self.overwrite,
            **own,
        )
        carry_on(settings, out)


@dataclass(frozen=True)
class MergeBlocks:
    """Merge the trained blocks of a plan into one scene: the Gaussians inside the box of each block."""

    city: CityPath
    """Folder of the plan."""
    out: Annotated[Path, tyro.conf.Positional, shown_as("OUT")]
    """Splat file to write; its suffix selects the format, as for splatax export."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        format_of(self.out)
        if self.out.exists() and not self.overwrite:
            raise InputError(
                f"{self.out}: exists. Choose another name, or replace it.", options=("overwrite",)
            )
        scene, kept = merged(self.city)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        for part in kept:
            say(f"block {part.block}: {part.gaussians:,} of {part.trained:,} Gaussians inside its box")
        written = sx.save(self.out, scene)
        say(f"{self.out}: {written:,} Gaussians of {len(kept)} blocks")
        tell_losses(self.out)


Action = Annotated[
    Annotated[PlanBlocks, tyro.conf.subcommand("plan", prefix_name=False)]
    | Annotated[TrainBlock, tyro.conf.subcommand("train", prefix_name=False)]
    | Annotated[MergeBlocks, tyro.conf.subcommand("merge", prefix_name=False)],
    tyro.conf.arg(name=""),
]


@dataclass(frozen=True)
class Blocks:
    """Train a capture that is too large for one run in blocks, one by one or as jobs of a cluster.

    plan divides the capture, train trains one block (on any machine, in any order), merge joins them.
    docs/scale.md describes it.
    """

    action: Action

    def run(self) -> None:
        try:
            self.action.run()
        except InputError as error:
            raise InputError(advice(error, self.action)) from error


def table_of(plan: Plan, photos: int) -> Table:
    """Returns the blocks of a plan as a table."""
    table = Table("block", f"photos of {photos:,}", "held out", "Gaussians", "steps")
    for number, block in enumerate(plan.blocks):
        sizes = len(block.photos), len(block.held_out), block.gaussians, block.steps
        table.add_row(str(number), *(f"{size:,}" for size in sizes))
    return table
