"""A SOG scene that is not zipped: its meta.json, with the textures beside it. Reading alone."""

from splatax.io.formats.sog import comments as comments
from splatax.io.formats.sog import load as load
