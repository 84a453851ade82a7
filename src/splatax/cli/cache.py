"""`splatax cache`: decoded photos on disk."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from splatax.cli.output import say
from splatax.runs.keeping import PLACE, SIZE, user_store
from splatax.runs.planning import gigabytes


@dataclass(frozen=True)
class Cache:
    """Show where decoded photos are kept on disk and how much space they take, or remove them.

    Photos that do not fit in memory are decoded once and kept there. The environment variables SPLATAX_CACHE
    and SPLATAX_CACHE_SIZE choose the folder and its maximum size.
    """

    clear: Annotated[bool, tyro.conf.arg(name="clear")] = False
    """Remove all kept photos. A run that uses them decodes its photos again."""

    def run(self) -> None:
        store = user_store()
        if store is None:
            say(f"no photos are kept: {SIZE} is 0")
            return
        size = store.size()
        if self.clear:
            say(f"{store.clear():,} files removed ({gigabytes(size)}) from {store.folder}")
            return
        say(f"{store.folder}: {gigabytes(size)} of at most {gigabytes(store.most)}")
        say(f"set {PLACE} for another folder, {SIZE} for another size; splatax cache --clear removes all")
