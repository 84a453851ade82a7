"""Triangle meshes of scenes: depth of many views is fused into a volume, whose surface is extracted.

record.py       the mesh: vertices, faces, colours; its area and components
views.py        what the cameras of a capture see: depth and colour, rendered on demand
resolution.py   size of the voxels, from the pixels and from how well the depth of the views agrees
volume.py       truncated signed distances, in blocks around what was seen
fusion.py       depth of views into the volume
surface.py      the volume's surface, by marching cubes
coloring.py     colours of vertices, from the views
extraction.py   all of these, one after the other
collision.py    closed meshes for physics
needed.py       the packages that meshes need
files.py        .ply, .glb and .obj
comparison.py   distances between a mesh and true surfaces
"""

from splatax.mesh.collision import COLLISION_COARSER as COLLISION_COARSER
from splatax.mesh.collision import COLLISION_FACES as COLLISION_FACES
from splatax.mesh.collision import collision_mesh as collision_mesh
from splatax.mesh.comparison import Agreement as Agreement
from splatax.mesh.comparison import Samples as Samples
from splatax.mesh.comparison import compare as compare
from splatax.mesh.comparison import samples_of as samples_of
from splatax.mesh.extraction import extract as extract
from splatax.mesh.files import save as save
from splatax.mesh.record import Mesh as Mesh
from splatax.mesh.resolution import Resolution as Resolution
from splatax.mesh.resolution import resolution_of as resolution_of
from splatax.mesh.views import DepthView as DepthView
from splatax.mesh.views import depth_views as depth_views
