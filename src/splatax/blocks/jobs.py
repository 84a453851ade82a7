"""Commands that train the blocks of a plan, for a shell and for schedulers."""

from pathlib import Path


def jobs(city: Path, blocks: int) -> list[str]:
    """Returns the commands that train the blocks of a plan, as lines for a shell."""
    last = blocks - 1
    return [
        "train the blocks one after another:",
        f"  for block in $(seq 0 {last}); do splatax blocks train {city} $block; done",
        "or as jobs of SLURM:",
        f"  CITY={city} sbatch --array=0-{last} docs/jobs/blocks.sh",
        "then merge them:",
        f"  splatax blocks merge {city} {city / 'scene.ply'}",
    ]
