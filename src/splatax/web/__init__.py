"""Scenes as single HTML files, which need no server and no network."""

from splatax.web.composition import Composition as Composition
from splatax.web.composition import compose as compose
from splatax.web.detail import LOD_ABOVE as LOD_ABOVE
from splatax.web.page import LOSES as LOSES
from splatax.web.page import MAX_SH_DEGREE as MAX_SH_DEGREE
from splatax.web.page import document as document
from splatax.web.page import require_viewer as require_viewer
from splatax.web.page import save as save
from splatax.web.presentation import Hotspot as Hotspot
from splatax.web.presentation import Presentation as Presentation
from splatax.web.skinned import Motion as Motion
