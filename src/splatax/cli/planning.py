"""What a run is planned by: the time that it may take."""

import splatax as sx
from splatax.budget import Plan, measured, plan
from splatax.cli.display import duration
from splatax.training.recipes import room_for


def within(seconds: float, recipe: sx.Recipe, dataset: sx.Dataset, most: int | None) -> Plan:
    """The numbers of steps and Gaussians that fit into a time, by the speed of this machine. Says them.

    Args:
        seconds: for the whole run.
        recipe: `default`, for some number of steps.
        dataset: the capture.
        most: how many Gaussians there shall be; None for as many as suit.
    """
    print("measuring the speed of this machine ...")
    camera = dataset.train[0].camera
    costs = measured((camera.width, camera.height), recipe)
    chosen = plan(costs, seconds, recipe.initialization.number(dataset), room_for(dataset), most)
    print(
        f"about {chosen.steps:,} steps and {chosen.max_gaussians:,} Gaussians in {duration(seconds)}, at "
        f"{1e3 * costs.step(chosen.max_gaussians):.0f} ms a step in the end"
    )
    return chosen
