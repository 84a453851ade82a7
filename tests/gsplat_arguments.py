"""The arguments of gsplat's `rasterization`, and those that docs/coming-from.md tells how to write."""

import re
from pathlib import Path

TABLE = Path(__file__).parents[1] / "docs" / "coming-from.md"

# As of gsplat's main branch of 2026 (the version that has `renderer_config`).
ARGUMENTS = [
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmats",
    "Ks",
    "width",
    "height",
    "near_plane",
    "far_plane",
    "radius_clip",
    "eps2d",
    "sh_degree",
    "packed",
    "tile_size",
    "backgrounds",
    "render_mode",
    "sparse_grad",
    "absgrad",
    "rasterize_mode",
    "distributed",
    "camera_model",
    "segmented",
    "covars",
    "with_ut",
    "with_eval3d",
    "macro_tile",
    "return_normals",
    "global_z_order",
    "rays",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
    "ftheta_coeffs",
    "lidar_coeffs",
    "external_distortion_coeffs",
    "rolling_shutter",
    "viewmats_rs",
    "ut_params",
    "extra_signals",
    "extra_signals_sh_degree",
    "renderer_config",
]


def tabled_arguments() -> set[str]:
    """Returns the names in the first column of the table of arguments."""
    rows = TABLE.read_text().split("| gsplat | splatax |")[1].split("\n\n")[0].splitlines()
    cells = [row.split("|")[1] for row in rows if row.startswith("| `")]
    return {name for cell in cells for name in re.findall(r"`(\w+)[^`]*`", cell)}
