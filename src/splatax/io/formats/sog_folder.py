"""SOG scenes that are not zipped: a meta.json with the textures beside it. They can only be read."""

from splatax.io.formats.sog import comments as comments
from splatax.io.formats.sog import load as load
