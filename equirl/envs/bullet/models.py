"""The two robots, derived from the Panda's description in PyBullet's data when they are loaded."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from equirl.envs.bullet.client import Client, panda_urdf
from equirl.envs.bullet.kinematics import hand_joints, panda_joints, panda_yaw
from equirl.envs.workspace import Workspace

__all__ = ["ROBOTS", "RobotLoader", "RobotModel"]

_HAND_LINKS = ("panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_grasptarget")
_HAND_JOINTS = ("panda_finger_joint1", "panda_finger_joint2", "panda_grasptarget_hand")


@dataclass(frozen=True)
class RobotModel:
    """How to build a robot and how its joints give a pose.

    Attributes:
        joint_names: Actuated joints that carry the hand.
        base_x: X of the base, m.
        joints: (positions (n, 3), yaws (n,)) -> joint values (n, J).
        yaw: Joint values (J,) -> yaw, rad, unbounded.
        derive: Edits the Panda's description in place.
    """

    joint_names: tuple[str, ...]
    base_x: float
    joints: Callable[[np.ndarray, np.ndarray], np.ndarray]
    yaw: Callable[[np.ndarray], float]
    derive: Callable[[ElementTree.Element], None]


def _panda(workspace: Workspace) -> RobotModel:
    return RobotModel(
        joint_names=tuple(f"panda_joint{i}" for i in range(1, 8)),
        base_x=workspace.arm_base_x,
        joints=partial(panda_joints, base_x=workspace.arm_base_x),
        yaw=panda_yaw,
        derive=_lift_yaw_limit,
    )


def _hand(workspace: Workspace) -> RobotModel:
    return RobotModel(
        joint_names=("move_x", "move_y", "move_z", "turn"),
        base_x=0.0,
        joints=hand_joints,
        yaw=lambda joints: float(joints[3]),
        derive=_free_hand,
    )


#: The robots by name, each made for a workspace: the arm with its hand, and the hand alone, free.
ROBOTS: Mapping[str, Callable[[Workspace], RobotModel]] = {"panda": _panda, "hand": _hand}


class RobotLoader:
    """Loads a robot into worlds; its description is derived once.

    Args:
        client: Where to.
        model: Which robot.
        visual: Keep the meshes that a picture needs; they make every picture of PyBullet slow and
            physics does not use them.
    """

    def __init__(self, client: Client, model: RobotModel, visual: bool = False):
        self.model = model
        self._client = client
        self._folder = tempfile.TemporaryDirectory(prefix="equirl_")
        self._path = Path(self._folder.name) / "robot.urdf"
        _describe(model, visual).write(self._path)

    def close(self) -> None:
        """Removes the description; harmless when done before."""
        self._folder.cleanup()

    def load(self) -> int:
        """Returns the id of a new robot."""
        return self._client.loadURDF(
            str(self._path),
            basePosition=(self.model.base_x, 0.0, 0.0),
            useFixedBase=True,
            flags=self._client.URDF_USE_INERTIA_FROM_FILE,
        )


def _describe(model: RobotModel, visual: bool) -> ElementTree.ElementTree:
    source = panda_urdf()
    root = ElementTree.parse(source).getroot()
    model.derive(root)
    for link in root.findall("link"):
        name = link.get("name")
        if not visual:
            _remove(link, "visual")
        if visual or name not in _HAND_LINKS:
            _remove(link, "collision")
    for mesh in root.iter("mesh"):
        filename = mesh.attrib["filename"].replace("package://", f"{source.parent}/")
        mesh.set("filename", filename)
    return ElementTree.ElementTree(root)


def _remove(element: ElementTree.Element, tag: str) -> None:
    for child in element.findall(tag):
        element.remove(child)


def _lift_yaw_limit(root: ElementTree.Element) -> None:
    """Makes joint 7 continuous: yaw is unbounded, and grasps were lost at that limit."""
    (joint,) = root.findall("joint[@name='panda_joint7']")
    joint.set("type", "continuous")
    _remove(joint, "limit")
    _remove(joint, "safety_controller")


def _free_hand(root: ElementTree.Element) -> None:
    """Replaces the arm by three sliders and a hinge; the hand points down, fingers along x."""
    for element in list(root):
        keep = _HAND_LINKS if element.tag == "link" else _HAND_JOINTS
        if element.tag in ("link", "joint") and element.get("name") not in keep:
            root.remove(element)
    parent = "base"
    _add_link(root, parent, mass=1.0)
    for name, axis in (("move_x", "1 0 0"), ("move_y", "0 1 0"), ("move_z", "0 0 1")):
        _add_joint(root, name, "prismatic", parent, f"{name}_link", axis=axis)
        _add_link(root, f"{name}_link", mass=0.5)
        parent = f"{name}_link"
    _add_joint(root, "turn", "continuous", parent, "turn_link", axis="0 0 1")
    _add_link(root, "turn_link", mass=0.5)
    tool_to_hand = {"xyz": "0 0 0.105", "rpy": f"{np.pi} 0 {np.pi / 2}"}
    _add_joint(root, "panda_hand_joint", "fixed", "turn_link", "panda_hand", origin=tool_to_hand)


def _add_link(root: ElementTree.Element, name: str, mass: float) -> None:
    inertial = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=name), "inertial")
    ElementTree.SubElement(inertial, "mass", value=str(mass))
    moments = {"ixx": "0.01", "iyy": "0.01", "izz": "0.01", "ixy": "0", "ixz": "0", "iyz": "0"}
    ElementTree.SubElement(inertial, "inertia", moments)


def _add_joint(
    root: ElementTree.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    axis: str | None = None,
    origin: dict[str, str] | None = None,
) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", origin or {"xyz": "0 0 0", "rpy": "0 0 0"})
    if axis is not None:
        ElementTree.SubElement(joint, "axis", xyz=axis)
    if kind == "prismatic":
        limits = {"lower": "-1", "upper": "1", "effort": "1000", "velocity": "10"}
        ElementTree.SubElement(joint, "limit", limits)
