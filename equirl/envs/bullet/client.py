"""One connection to PyBullet."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

__all__ = ["Client", "panda_urdf"]


class Client:
    """PyBullet's functions bound to a simulation of our own; the connection is made here.

    PyBullet is imported only now: importing `equirl.envs` costs nothing and prints nothing.
    """

    def __init__(self) -> None:
        import pybullet

        if not pybullet.isNumpyEnabled():
            raise RuntimeError("this build of PyBullet lacks numpy support; install pybullet 3.2.7")
        self._pybullet = pybullet
        self._id = pybullet.connect(pybullet.DIRECT)
        if self._id < 0:
            raise RuntimeError(f"PyBullet refused another simulation (connect gave {self._id})")

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self._id)
        self.__dict__[name] = value  # the next access is a plain attribute
        return value

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        if self._id >= 0 and self._pybullet.isConnected(self._id):
            self._pybullet.disconnect(self._id)
        self._id = -1


def panda_urdf() -> Path:
    """Returns the path of the Panda's description in PyBullet's data (Apache-2.0)."""
    import pybullet_data

    return Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
