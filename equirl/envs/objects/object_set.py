"""A set of bodies, by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping

from equirl.envs.objects.bodies import Body

__all__ = ["FRICTION", "HOUSEHOLD_ROLLING", "MASS", "MESH_ROLLING", "ObjectSet"]

# Of objects to grasp. Mass, friction and the rolling friction of the household objects are those of
# the paper's implementation; of meshes, the rolling friction is chosen.
MASS = 0.15  # kg
FRICTION = 0.6
HOUSEHOLD_ROLLING = 0.005  # m; so that round objects come to rest
MESH_ROLLING = 0.001  # m


class ObjectSet(Mapping[str, Body]):
    """Bodies that scenes are drawn from, by name and in a fixed order.

    Args:
        bodies: The bodies; their names must differ.
        source: What the set is called in messages.

    Raises:
        ValueError: If there is no body, or two have one name.
    """

    def __init__(self, bodies: Iterable[Body], source: str):
        bodies = tuple(bodies)
        self.source = source
        self._bodies = {body.name: body for body in bodies}
        if not bodies:
            raise ValueError(f"{source}: an object set needs at least one object")
        if len(self._bodies) < len(bodies):
            names = [body.name for body in bodies]
            twice = sorted({name for name in names if names.count(name) > 1})
            raise ValueError(f"{source}: several objects are called {', '.join(twice)}")

    def __getitem__(self, name: str) -> Body:
        try:
            return self._bodies[name]
        except KeyError:
            close = (
                difflib.get_close_matches(str(name), self._bodies, n=3) or list(self._bodies)[:3]
            )
            raise KeyError(
                f"unknown object {name!r} in {self.source}, which has {len(self)}, "
                f"for example {', '.join(close)}"
            ) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._bodies)

    def __len__(self) -> int:
        return len(self._bodies)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.source!r}, {len(self)} objects)"

    def subset(self, names: Iterable[str]) -> ObjectSet:
        """Returns the set of the bodies with these ``names``, in the order given.

        Raises:
            KeyError: If there is no such body.
        """
        return ObjectSet((self[name] for name in names), f"a part of {self.source}")
