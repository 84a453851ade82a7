"""The ways in which a training run starts: new, resumed from a checkpoint, or repeated.

Each way decides what the settings leave open before the first step. A new run examines its photos and plans
its steps; a repeated run takes over these decisions; a resumed run takes over everything. Both read the
memory of this machine again.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatax.cli.output import say
from splatax.cli.planning import drawn_here, planned, with_default_steps
from splatax.cli.preparing import prepared
from splatax.cli.settings import Settings
from splatax.dataset import Dataset, photos_in
from splatax.errors import InputError
from splatax.io.datasets.photos import counted
from splatax.io.memory import decoding
from splatax.runs.clock import Expected
from splatax.runs.history import History
from splatax.runs.planning import Deadline, Room, gigabytes, room_within
from splatax.runs.resume import Earlier
from splatax.training.loop import RunState
from splatax.training.recipes import Recipe

MAY_CHANGE = {  # on resuming
    "scene",
    "points",
    "judged_by",
    "title",
    "memory",
    "checkpoint_every",
    "checkpoint_steps",
}


@dataclass(frozen=True)
class Decided:
    """A run about which all is decided.

    Attributes:
        settings: of the run.
        dataset: the capture.
        room: memory of this process.
        expected: planned cost of the steps; None without a plan.
        deadline: of the whole command; None if only training is limited.
    """

    settings: Settings
    dataset: Dataset
    room: Room
    expected: Expected | None = None
    deadline: Deadline | None = None


@dataclass(frozen=True)
class Run(ABC):
    """A training run before its first step.

    Attributes:
        settings: of the run.
        history: record of the run until now.
    """

    settings: Settings
    history: History = field(default_factory=History)

    def checked(self) -> "Run":
        """Returns the run with absolute paths of its input files.

        Raises:
            InputError: if a setting makes no sense, or none names a capture.
        """
        self.settings.check()
        if self.settings.scene is None:
            raise InputError("No capture is given. Name its folder, or a run to resume: --resume RUN.")
        return replace(self, settings=self.settings.absolute())

    @property
    def scene(self) -> Path:
        """Folder of the capture."""
        assert self.settings.scene
        return self.settings.scene

    @property
    def out(self) -> Path:
        """Folder of the run."""
        return self.settings.out or Path("runs") / self.scene.resolve().name

    @property
    def title(self) -> str:
        """Title of the report."""
        return self.settings.title or self.scene.resolve().name

    @property
    def may_replace(self) -> bool:
        """True if the run may replace what is in its folder."""
        return self.settings.overwrite

    @abstractmethod
    def decided(self, dataset: Dataset) -> Decided:
        """Decides what the settings leave open, and prints each decision in one line.

        Args:
            dataset: the capture.
        """

    @property
    def checkpoint(self) -> Path | None:
        """The checkpoint to continue from; None before the first step."""
        return None

    def state(self, recipe: Recipe, dataset: Dataset) -> RunState | None:
        """Returns the state to continue from, on the device; None before the first step."""
        return None


@dataclass(frozen=True)
class NewRun(Run):
    """A run that starts from its capture.

    Attributes:
        steps_given: whether the user has chosen the number of steps. Otherwise it follows from a budget, or
            from the number of photos.
        deadline: of the whole command; None if only training is limited.
    """

    steps_given: bool = field(default=False, kw_only=True)
    deadline: Deadline | None = field(default=None, kw_only=True)

    def decided(self, dataset: Dataset) -> Decided:
        """Examines the photos, and plans steps and Gaussians."""
        settings, dataset = prepared(self.settings, dataset, self.out)
        settings = with_background(settings, dataset)
        tell_equal_weights(settings, dataset)
        room = memory_for(settings, dataset)
        if not (settings.budget or self.steps_given):
            settings = with_default_steps(settings, dataset)
        return planned_within(settings, dataset, room, self.deadline)


@dataclass(frozen=True)
class RepeatedRun(Run):
    """A run with the decisions of a finished one; its history has the changes of the number of steps."""

    def decided(self, dataset: Dataset) -> Decided:
        """Checks that the Gaussians fit into the memory."""
        settings = with_background(self.settings, dataset)
        return planned_within(settings, dataset, memory_for(settings, dataset))


@dataclass(frozen=True)
class ResumedRun(Run):
    """A run that continues from a checkpoint.

    Attributes:
        earlier: the run that was stopped.
    """

    earlier: Earlier = field(kw_only=True)

    def checked(self) -> Run:
        """Returns the run with absolute paths of its input files.

        Raises:
            InputError: also if the capture is not where it was.
        """
        run = super().checked()
        if not run.scene.exists():
            raise InputError(
                f"{run.scene}: the capture of the run is not there. If it has moved, name its new folder: "
                f"splatax train FOLDER --resume {self.earlier.run}"
            )
        return run

    @property
    def out(self) -> Path:
        """Folder of the run, which may have moved since it started."""
        return self.earlier.run

    @property
    def may_replace(self) -> bool:
        """True: the run continues in its folder."""
        return True

    def decided(self, dataset: Dataset) -> Decided:
        """Takes over all decisions; only the memory for photos follows this machine."""
        settings = with_background(self.settings, dataset)
        return Decided(settings, dataset, memory_for(settings, dataset))

    @property
    def checkpoint(self) -> Path:
        """The checkpoint to continue from."""
        return self.earlier.path

    def state(self, recipe: Recipe, dataset: Dataset) -> RunState:
        """Returns the state in the checkpoint, on the device."""
        return self.earlier.state(recipe, dataset)


def with_background(settings: Settings, dataset: Dataset) -> Settings:
    """Returns settings with the background of the capture unless they name one; prints it."""
    if settings.background or not dataset.background:
        return settings
    say(f"background: {dataset.background}, the convention of Blender's captures. Change it: --background")
    return replace(settings, background=dataset.background)


def tell_equal_weights(settings: Settings, dataset: Dataset) -> None:
    """Prints if photos have equal weights only because there are few of them."""
    if settings.too_few_to_weigh(dataset):
        only = counted(photos_in(dataset.train), "training photo")
        say(
            f"with only {only}, those that do not fit the others keep their weight. Reduce it: "
            "--photo-weights robust"
        )


def memory_for(settings: Settings, dataset: Dataset) -> Room:
    """Returns the memory of a run, and limits that of threads that decode photos; prints a limit."""
    first = settings.initialization().number(dataset)
    room = room_within(settings.memory_bytes, dataset, first, *drawn_here(settings.views))
    if settings.memory_bytes:
        say(f"within {gigabytes(settings.memory_bytes)}: {room}")
    decoding.limit = room.decoding
    return room


def planned_within(
    settings: Settings, dataset: Dataset, room: Room, deadline: Deadline | None = None
) -> Decided:
    """Plans a run; see `cli.planning.planned`."""
    settings, dataset, expected = planned(settings, dataset, room, deadline)
    return Decided(settings, dataset, room, expected, deadline)
