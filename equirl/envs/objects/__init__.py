"""Bodies to manipulate."""

from equirl.envs.objects.bodies import Body, ConvexPolyhedron, cube, sorted_extents
from equirl.envs.objects.bowl import bowl
from equirl.envs.objects.object_set import ObjectSet

__all__ = ["Body", "ConvexPolyhedron", "ObjectSet", "bowl", "cube", "sorted_extents"]
