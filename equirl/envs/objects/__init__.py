"""Bodies to manipulate."""

from equirl.envs.objects.bodies import Body, ConvexPolyhedron, cube

__all__ = ["Body", "ConvexPolyhedron", "cube"]
