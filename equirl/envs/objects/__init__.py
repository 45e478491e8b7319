"""Bodies to manipulate."""

from equirl.envs.objects.bodies import Body, ConvexPolyhedron, cube
from equirl.envs.objects.bowl import bowl
from equirl.envs.objects.convex_pieces import MeshError
from equirl.envs.objects.household import household_objects
from equirl.envs.objects.mesh_folder import MeshFolder
from equirl.envs.objects.object_set import ObjectSet

__all__ = [
    "Body",
    "ConvexPolyhedron",
    "MeshError",
    "MeshFolder",
    "ObjectSet",
    "bowl",
    "cube",
    "household_objects",
]
