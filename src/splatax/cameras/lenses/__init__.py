"""Lenses of cameras. A new one is a small pytree in a file here, and a line in `LENSES`.

The line enrols it in the contract suite, `tests/contracts/test_lenses.py`.
"""

from splatax.cameras.lenses.fisheye import Fisheye as Fisheye
from splatax.cameras.lenses.fisheye import FTheta as FTheta
from splatax.cameras.lenses.fisheye import RadTanThinPrismFisheye as RadTanThinPrismFisheye
from splatax.cameras.lenses.fisheye import ThinPrismFisheye as ThinPrismFisheye
from splatax.cameras.lenses.perspective import FieldOfView as FieldOfView
from splatax.cameras.lenses.perspective import OpenCV as OpenCV
from splatax.cameras.lenses.perspective import Pinhole as Pinhole
from splatax.cameras.lenses.perspective import opencv as opencv
from splatax.cameras.lenses.protocol import Lens as Lens
from splatax.cameras.lenses.whole import Equirectangular as Equirectangular
from splatax.cameras.lenses.whole import Orthographic as Orthographic

LENSES: dict[str, type[Lens]] = {
    "pinhole": Pinhole,
    "opencv": OpenCV,
    "field-of-view": FieldOfView,
    "fisheye": Fisheye,
    "thin-prism-fisheye": ThinPrismFisheye,
    "rad-tan-thin-prism-fisheye": RadTanThinPrismFisheye,
    "f-theta": FTheta,
    "equirectangular": Equirectangular,
    "orthographic": Orthographic,
}
