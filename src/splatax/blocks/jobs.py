"""Commands that train the blocks of a plan, for a shell and for schedulers."""

from pathlib import Path


def jobs(city: Path, blocks: int) -> list[str]:
    """Returns the commands that train the blocks of a plan, as lines for a shell."""
    last = blocks - 1
    launch = "sky jobs launch -y -d --env BLOCK=$block docs/jobs/blocks.yaml"
    return [
        "train the blocks one after another:",
        f"  for block in $(seq 0 {last}); do splatax blocks train {city} $block; done",
        "or as jobs of SLURM:",
        f"  CITY={city} sbatch --array=0-{last} docs/jobs/blocks.sh",
        "or as jobs of SkyPilot, once the file names your storage and the folder of the plan there:",
        f"  for block in $(seq 0 {last}); do {launch}; done",
        "then merge them:",
        f"  splatax blocks merge {city} {city / 'scene.ply'}",
    ]
