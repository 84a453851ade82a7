"""3D Gaussian Splatting in JAX: from photos to a scene, the same code on CPU, GPU and TPU.

Names are imported on first use, so `import splatax` is fast, and the renderer works where packages that
only other parts need are not installed.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.2.0"  # another one whenever a training step computes something else; see docs/resume.md

HOMES = {  # public name -> module here that defines it
    "AlongRays": "low_pass",
    "Antialiasing": "low_pass",
    "BLACK": "rendering",
    "Camera": "cameras",
    "Dataset": "dataset",
    "DatasetError": "errors",
    "Dilation": "low_pass",
    "FormatError": "errors",
    "Gaussians": "gaussians",
    "InputError": "errors",
    "Part": "scene",
    "PointCloud": "dataset",
    "Progress": "training.loop",
    "Recipe": "training.recipes",
    "Renderer": "rendering",
    "Rendering": "outputs",
    "Scene": "scene",
    "Scores": "evaluation",
    "Sky": "sky",
    "Splats": "splats",
    "View": "dataset",
    "WHITE": "rendering",
    "composite": "stages",
    "demo_dataset": "demo.dataset",
    "evaluate": "evaluation",
    "fit": "training.loop",
    "load": "io.formats",
    "load_dataset": "io.datasets",
    "load_scene": "io.scenes",
    "look_at": "cameras",
    "optimize": "training.loop",
    "project": "stages",
    "rasterize": "rendering",
    "render": "rendering",
    "save": "io.formats",
    "save_scene": "io.scenes",
    "skin": "scene.skin",
    "view": "notebook",
}
SUBMODULES = {  # public name -> module here
    "adjustment": "adjustment",
    "backends": "backends",
    "editing": "editing",
    "forecast": "runs.forecast",
    "inspection": "inspection",
    "losses": "losses",
    "lpips": "lpips",
    "mesh": "mesh",
    "metrics": "metrics",
    "outputs": "outputs",
    "recipes": "training.recipes",
    "reconstruction": "reconstruction",
    "scene": "scene",
    "sensors": "sensors",
    "splits": "splits",
    "training": "training",
    "trajectories": "trajectories",
    "transforms": "transforms",
    "twins": "twins",
    "viewer": "viewer",
    "web": "web",
}

if TYPE_CHECKING:  # the same names, for type checkers and editors; tests/test_importing.py compares them
    from splatax import adjustment as adjustment
    from splatax import backends as backends
    from splatax import editing as editing
    from splatax import inspection as inspection
    from splatax import losses as losses
    from splatax import lpips as lpips
    from splatax import mesh as mesh
    from splatax import metrics as metrics
    from splatax import outputs as outputs
    from splatax import reconstruction as reconstruction
    from splatax import scene as scene
    from splatax import sensors as sensors
    from splatax import splits as splits
    from splatax import training as training
    from splatax import trajectories as trajectories
    from splatax import transforms as transforms
    from splatax import twins as twins
    from splatax import viewer as viewer
    from splatax import web as web
    from splatax.cameras import Camera as Camera
    from splatax.cameras import look_at as look_at
    from splatax.dataset import Dataset as Dataset
    from splatax.dataset import PointCloud as PointCloud
    from splatax.dataset import View as View
    from splatax.demo.dataset import demo_dataset as demo_dataset
    from splatax.errors import DatasetError as DatasetError
    from splatax.errors import FormatError as FormatError
    from splatax.errors import InputError as InputError
    from splatax.evaluation import Scores as Scores
    from splatax.evaluation import evaluate as evaluate
    from splatax.gaussians import Gaussians as Gaussians
    from splatax.io.datasets import load_dataset as load_dataset
    from splatax.io.formats import load as load
    from splatax.io.formats import save as save
    from splatax.io.scenes import load_scene as load_scene
    from splatax.io.scenes import save_scene as save_scene
    from splatax.low_pass import AlongRays as AlongRays
    from splatax.low_pass import Antialiasing as Antialiasing
    from splatax.low_pass import Dilation as Dilation
    from splatax.notebook import view as view
    from splatax.outputs import Rendering as Rendering
    from splatax.rendering import BLACK as BLACK
    from splatax.rendering import WHITE as WHITE
    from splatax.rendering import Renderer as Renderer
    from splatax.rendering import rasterize as rasterize
    from splatax.rendering import render as render
    from splatax.runs import forecast as forecast
    from splatax.scene import Part as Part
    from splatax.scene import Scene as Scene
    from splatax.scene.skin import skin as skin
    from splatax.sky import Sky as Sky
    from splatax.splats import Splats as Splats
    from splatax.stages import composite as composite
    from splatax.stages import project as project
    from splatax.training import recipes as recipes
    from splatax.training.loop import Progress as Progress
    from splatax.training.loop import fit as fit
    from splatax.training.loop import optimize as optimize
    from splatax.training.recipes import Recipe as Recipe
else:

    def __getattr__(name: str) -> object:
        """Imports a public name on first use (PEP 562)."""
        if name not in HOMES and name not in SUBMODULES:
            raise AttributeError(f"module 'splatax' has no attribute {name!r}")
        module = f"splatax.{HOMES.get(name) or SUBMODULES[name]}"
        from splatax.packages import required_by

        with required_by(f"splatax.{name}"):
            home = importlib.import_module(module)
        value = getattr(home, name) if name in HOMES else home
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted([*HOMES, *SUBMODULES, "__version__"])
