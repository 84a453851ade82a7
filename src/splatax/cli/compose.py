"""`splatax compose`: parts from splat files as one scene, with variants, as a page or a .glb file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatax import web
from splatax.cli.options import OverwriteFlag
from splatax.cli.output import say
from splatax.cli.page import is_page, tell_losses
from splatax.errors import InputError
from splatax.io.rigs import save_animated
from splatax.io.scenes import save_scene
from splatax.scene import AnimatedScene


@dataclass(frozen=True)
class Compose:
    """Compose a scene of parts with variants, as a web page or a .glb file.

    A .toml file gives the splat file and the pose of each part, the clips that parts play, the variants,
    notes, the first view and a camera path; docs/configurator.md lists its keys. A page has a button for each
    option of a variant. A .glb file has a node for each part, skins and clips, and shows the first option of
    each variant; splatax reads the others from it too.
    """

    composition: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.{toml,glb}")]
    """The file that describes the scene, or a .glb file of parts and variants that this command wrote."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The file to write, .html or .glb."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        if not is_page(self.out) and self.out.suffix.lower() != ".glb":
            raise InputError(f"{self.out}: a composition is written as .html or .glb. Choose such a name.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        if is_page(self.out):
            web.require_viewer()
        found = web.compose(self.composition)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        if is_page(self.out):
            web.save(
                self.out,
                found.scene,
                title=found.title,
                background=found.background,
                presentation=found.presentation,
                motion=found.motions,
            )
        else:
            self._save(found)
        options = sum(map(len, found.presentation.variants.values()))
        say(
            f"{self.out}: {len(found.scene.parts)} parts, {len(found.scene):,} Gaussians, "
            f"{options} options of {len(found.presentation.variants)} variants, "
            f"{len(found.motions)} parts that move, "
            f"{self.out.stat().st_size / 1e6:.1f} MB"
        )
        tell_losses(self.out)

    def _save(self, found: web.Composition) -> None:
        """Writes the .glb file."""
        variants, comments = found.presentation.variants, (found.title,)
        if not found.motions:
            save_scene(self.out, found.scene, variants=variants, comments=comments)
            return
        rigs = {name: motion.rig for name, motion in found.motions.items()}
        clips = {motion.clip.name: motion.clip for motion in found.motions.values()}
        if not all(motion.clip.equals(clips[motion.clip.name]) for motion in found.motions.values()):
            raise InputError(
                f"{self.out}: parts play different clips of one name. Rename one, or write a page."
            )
        try:
            animated = AnimatedScene(found.scene, rigs, clips)
        except ValueError as error:
            raise InputError(f"{self.out}: {error} A page can have several skeletons.") from error
        save_animated(self.out, animated, variants=variants, comments=comments)
