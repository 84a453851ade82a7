"""`splatax train`: from a capture to a scene."""

from collections.abc import Mapping, Set
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import tyro

import splatax as sx
from splatax.budget import Changes, Clock
from splatax.cli.checkpoints import Checkpoints
from splatax.cli.options import (
    AppearanceName,
    BackendName,
    BackgroundName,
    Downscale,
    LowPassName,
    RefinementName,
    load_scene,
    resolve_backend,
)
from splatax.cli.output import say
from splatax.cli.planning import Room, parse_budget, parse_bytes, room_within, shrunk, within
from splatax.cli.results import Run, conclude
from splatax.cli.resume import OTHER, Earlier, facts, find
from splatax.cli.runs import finished
from splatax.cli.session import Session, all_made, claim
from splatax.cli.view import audience
from splatax.errors import InputError
from splatax.projection import LOW_PASSES
from splatax.report.history import History
from splatax.runs.records import typed_fields, understood
from splatax.training.appearance import APPEARANCES
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.camera_refinement import CAMERA_REFINEMENTS
from splatax.training.protocols import Initialization
from splatax.training.recipes import PRESETS
from splatax.viewer.server import LOCAL, PORT

WATCHING = {"view", "host", "port"}
FREE = {"scene", "title", "resume", "repeat", "checkpoint_every", "checkpoint_steps"} | WATCHING
NOT_REPEATED = {"out": None, "overwrite": False, "budget": None}  # a plan is repeated as it was made

RecipeName = Literal[*PRESETS]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Train:
    """Train a scene on a capture.

    Writes scene.ply, metrics.json, config.json, report.html and progress.gif. Ctrl-C ends training
    early and writes what has been reached; --resume goes on from there, or from the last checkpoint of
    a run that crashed, and comes to the same scene as without the stop.
    """

    scene: tyro.conf.Positional[Path | None] = None
    """Folder of the capture, or a zip file of it: photos with a COLMAP model (images/ and sparse/0/),
    transforms.json, or LLFF's poses_bounds.npy. Photos without poses: splatax reconstruct."""
    out: Path | None = None
    """Folder for the results. Without it: runs/NAME, with the name of the capture's folder."""
    title: str | None = None
    """Of the report. Without it: the name of the capture's folder."""
    budget: str | None = None
    """Train for so long, such as 30s, 5min or 1h: plans --steps and --max-gaussians by the measured speed
    of this machine, and keeps to the time by the clock. config.json then has what --repeat repeats."""
    memory: str | None = None
    """The most memory to use, such as 4GB: limits --max-gaussians, and photos that do not fit are read
    again for each step. Without it: what scene and photos want, but for photos half of what there is."""
    steps: int = 30_000
    """How many photos to learn from, one after the other."""
    downscale: Downscale = "auto"
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""
    recipe: RecipeName = "default"
    """How to train. "default": the best known; "classic": Kerbl et al. 2023; "absgrad": Ye et al. 2024;
    "mcmc": Kheradmand et al. 2024."""
    max_gaussians: Literal["auto"] | int = "auto"
    """The most Gaussians that the scene may grow to; all recipes but "classic" and "absgrad" do grow to
    it. "auto": as many as the photos have detail for; with those two 5,000,000, which they rarely reach."""
    init: Literal["sfm", "random"] = "sfm"
    """Start from the capture's points, or at random where the cameras look."""
    background: BackgroundName | None = None
    """Behind the scene, and behind photos with alpha. "random" changes each step, against haze, and is
    black in evaluations. Without it: white for Blender's scenes; else the recipe's, random for
    "default", else black."""
    low_pass: LowPassName = "dilation"
    """What keeps thin Gaussians visible. "antialiasing" also keeps their brightness from afar."""
    appearance: AppearanceName = "none"
    """What may differ between photos. "exposure": exposure and white balance, an affine map of colours for
    each. The scene has the colours of their mean; held-out photos are compared as they are, and once more
    after a correction of colour."""
    refine: RefinementName = "none"
    """What to improve of the training cameras, if they are wrong (right ones get worse): "poses", or
    "poses+focal". Writes them to refined/sparse/0. Held-out photos keep those that they were given."""
    backend: BackendName = "auto"
    """Rasterizer. One asked for by name is never replaced by another."""
    seed: int = 0
    """Of all randomness: the same seed gives the same scene on the same machine."""
    eval_every: int = 0
    """Steps between evaluations of the held-out photos. 0: at the end alone."""
    checkpoint_every: float = 120.0
    """Seconds between checkpoints, of which the last two are kept until the run ends. 0: only when
    it is interrupted."""
    checkpoint_steps: int = 0
    """Steps between checkpoints, besides. 0: by the clock alone."""
    view: bool = False
    """Watch in the browser while it trains."""
    host: str = LOCAL[0]
    """Who may watch: this machine alone; "0.0.0.0" is all who can reach it."""
    port: int = PORT
    """Where to watch; the next free one if it is taken."""
    resume: Path | None = None
    """Go on with a run that was stopped: its folder, or one of its checkpoints. All other options are
    as it was started with."""
    repeat: Path | None = None
    """Make a finished run again, from its folder: with its options, and as many steps as it came to."""
    overwrite: bool = False
    """Replace the results of an earlier run in the same folder."""

    def run(self) -> None:
        if self.resume is not None:
            self.go_on(find(self.resume))
        elif self.repeat is not None:
            stored, made = finished(self.repeat, {field.name for field in fields(self)})
            with understood(self.repeat, "Repeat another run."):
                again = self.as_started(stored | NOT_REPEATED, FREE | NOT_REPEATED.keys())
            again.start(History(changes=made), Changes(made))
        else:
            self.refuse_what_a_budget_decides()
            history = History()
            self.start(history, self.pace(history))

    def go_on(self, earlier: Earlier) -> None:
        """Goes on with a run."""
        with understood(earlier.path, OTHER):
            options = self.as_started(earlier.options)
        options.start(earlier.history, options.pace(earlier.history), earlier)

    def pace(self, history: History) -> Changes:
        """What may change the number of steps while the run goes on."""
        if self.budget is None:
            return Changes(history.changes)
        seconds, checked = parse_budget(self.budget), (history.steps, history.train_seconds)
        return Clock(history.changes, seconds, checked)

    def as_started(self, options: Mapping[str, Any], free: Set[str] = FREE) -> "Train":
        """The options of a run, with those of these that are free to change.

        Raises:
            InputError: if others are given.
        """
        stored = typed_fields(Train, options)
        for field in fields(self):
            value = getattr(self, field.name)
            if value in (field.default, stored[field.name]):
                continue
            if field.name not in free:
                raise InputError(
                    f"--{field.name.replace('_', '-')} {value}: the run was started with "
                    f"{stored[field.name]}, and goes on with that. Leave the option out, or start a new run."
                )
            stored[field.name] = value
        return Train(**{**stored, "resume": None, "repeat": None})

    def start(self, history: History, changes: Changes, earlier: Earlier | None = None) -> None:
        """Trains, from the beginning or from a checkpoint.

        Args:
            history: of the run until now.
            changes: of the number of steps.
            earlier: the checkpoint to go on from.
        """
        if self.scene is None:
            raise InputError("Which capture? Name its folder, or a run to go on with: --resume RUN.")
        scene = self.scene.absolute()  # a run may go on from another folder
        dataset = self.capture()
        out = earlier.run if earlier else self.out or Path("runs") / scene.resolve().name
        with claim(out, self.overwrite or earlier is not None):
            settled = replace(self, scene=scene, background=self.background or dataset.background)
            room = room_within(self.memory, dataset, self.initialization().number(dataset))
            if earlier is None:
                settled, dataset = settled.planned(dataset, room)
            recipe = settled.to_recipe(dataset)
            checkpoints = Checkpoints(
                out,
                facts(asdict(settled), recipe, dataset),
                seconds=self.checkpoint_every,
                steps=self.checkpoint_steps,
                earlier=earlier.path if earlier else None,
            )
            state = earlier.state(recipe, dataset) if earlier else None
            if state:
                then = "writing the results" if all_made(state) else "going on"
                say(f"{then} after step {history.steps:,} of {int(state.train.total):,}")
            watched = audience(dataset, recipe, self.host, self.port) if self.view else nullcontext()
            with checkpoints, watched as watchers:
                session = Session(
                    dataset, recipe, checkpoints, history, changes, self.eval_every, watchers, room.photos
                )
                last = session.train(state)
                title = self.title or scene.resolve().name
                conclude(Run(title, dataset, recipe, history, last, asdict(settled), out))
            if history.interrupted:
                say(f"stopped at step {history.steps:,}. Go on: splatax train --resume {out}")
            else:
                checkpoints.discard()

    def capture(self) -> sx.Dataset:
        """What to train on. Says what there is to say of it.

        Raises:
            InputError: if the options do not suit it, or make no sense.
        """
        assert self.scene
        self.refuse_what_is_out_of_range()
        dataset = load_scene(self.scene, self.downscale)
        for note in dataset.notes:
            say(note)
        if self.init == "sfm" and not len(dataset.points):
            raise InputError(
                f"{self.scene}: the capture has no points to start from. Start at random: --init random."
            )
        return dataset

    def planned(self, dataset: sx.Dataset, room: Room) -> "tuple[Train, sx.Dataset]":
        """The same with the numbers of steps and Gaussians, and for short budgets with the size of photos,
        that fit into the budget and the memory; and the capture at that size.

        Raises:
            InputError: if more Gaussians are asked for than there is room for.
        """
        assert self.scene
        asked = None if self.max_gaussians == "auto" else self.max_gaussians
        if asked and asked > room.gaussians:
            raise InputError(
                f"--max-gaussians {asked}: --memory {self.memory} has room for {room.gaussians:,}. "
                "Give more memory, or ask for fewer."
            )
        fit = int(min(self.most(dataset), room.gaussians))
        if self.budget is None:
            return (self if fit == self.most(dataset) else replace(self, max_gaussians=fit)), dataset
        chosen = within(parse_budget(self.budget), self.to_recipe(dataset), dataset, fit, asked)
        settled = replace(self, steps=chosen.steps, max_gaussians=chosen.max_gaussians)
        smaller = shrunk(self.scene, dataset, chosen.steps) if self.downscale == "auto" else None
        if smaller is None:
            return settled, dataset
        downscale, dataset = smaller
        say(f"too few steps for photos of this size: --downscale {downscale}")
        return replace(self, downscale=downscale).planned(dataset, room)

    def most(self, dataset: sx.Dataset) -> int:
        """How many Gaussians there may be, but for memory."""
        if self.max_gaussians != "auto":
            return self.max_gaussians
        return PRESETS[self.recipe].max_gaussians(dataset)

    def refuse_what_is_out_of_range(self) -> None:
        """Raises InputError if a number makes no sense."""
        lowest = {"steps": 1, "max_gaussians": 1, "seed": 0, "checkpoint_every": 0, "checkpoint_steps": 0}
        for option, least in lowest.items():
            value = getattr(self, option)
            if value != "auto" and value < least:
                raise InputError(f"--{option.replace('_', '-')}: at least {least}, not {value}.")
        if self.memory is not None:
            parse_bytes(self.memory)

    def refuse_what_a_budget_decides(self) -> None:
        """Raises InputError if there is a budget that is no time, or nothing is left for it to plan."""
        if self.budget is None:
            return
        if not PRESETS[self.recipe].plannable or self.steps != Train.steps:
            plannable = " or ".join(name for name, preset in PRESETS.items() if preset.plannable)
            raise InputError(
                f"--budget: plans the steps of the recipe {plannable}. Leave out --recipe and --steps."
            )
        parse_budget(self.budget)

    def to_recipe(self, dataset: sx.Dataset) -> sx.Recipe:
        """The recipe that the options describe, for a capture.

        Raises:
            InputError: if the backend cannot run here.
        """
        recipe = PRESETS[self.recipe].build(steps=self.steps, max_gaussians=self.most(dataset))
        return replace(
            recipe,
            initialization=self.initialization(),
            background=BACKGROUNDS[self.background] if self.background else recipe.background,
            appearance=APPEARANCES[self.appearance],
            camera_refinement=CAMERA_REFINEMENTS[self.refine],
            low_pass=LOW_PASSES[self.low_pass],
            backend=resolve_backend(self.backend),
            seed=self.seed,
        )

    def initialization(self) -> Initialization:
        """Returns how the first Gaussians are created."""
        preset = PRESETS[self.recipe]
        return preset.random_start if self.init == "random" else preset.build(steps=self.steps).initialization
