"""What the networks are tested on: scenes, symmetric ones too, and small networks in float64."""

import pytest
import torch
from tensordict import TensorDict

from tests.equivariance import turn_image

slow = pytest.mark.slow
CONTINUOUS = ("SO2", "O2")
GROUPS = ("C4", "D4", "C8", "D8", "SO2", "O2", "C2", "D2")
GROUPS += tuple(pytest.param(group, marks=slow) for group in ("C6", "C3", "D3"))
#: All but the random one meet ties in every maximum that a symmetry of the scene maps to itself.
SCENES = ("random", "cube under the gripper", "ring", "constant", "invariant under D4", "nothing")


def scenes(kind, size, batch=3):
    """Depths of three kinds, an empty hand and a full one."""
    generator = torch.Generator().manual_seed(7)
    noise = 0.32 * torch.rand(batch, 1, size, size, generator=generator, dtype=torch.float64)
    heights = torch.linspace(0.02, 0.1, batch, dtype=torch.float64)[:, None, None, None]
    grid = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    x, y = grid[:, None] / size, grid[None, :] / size
    masks = {
        "cube under the gripper": (x.abs() < 0.125) & (y.abs() < 0.125),
        "ring": ((x**2 + y**2).sqrt() - 0.25).abs() < 0.08,
        "constant": torch.ones(size, size, dtype=bool),
    }
    if kind in masks:
        depth = 0.2 - heights * masks[kind]
    elif kind == "invariant under D4":
        moved = [turn_image(noise, turns, flip) for turns in range(4) for flip in (False, True)]
        depth = torch.stack(moved).amax(0)  # exactly, as a mean would not be
    else:
        assert kind in ("random", "nothing")
        depth = noise if kind == "random" else torch.zeros_like(noise)
    holding = torch.zeros(batch, 1, dtype=torch.float64)
    if kind != "nothing":
        holding[1::2] = 1.0
    return TensorDict(depth=depth, holding=holding, batch_size=batch)


def actions(scale=1.0, batch=3):
    generator = torch.Generator().manual_seed(5)
    return scale * (2 * torch.rand(batch, 5, generator=generator, dtype=torch.float64) - 1)


def prepared(network, scene="random"):
    """In float64; with biases, unless zero features are wanted."""
    generator = torch.Generator().manual_seed(3)
    if scene != "nothing":
        for name, parameter in network.named_parameters():
            if name.endswith("bias"):
                parameter.data.normal_(generator=generator).mul_(0.1)
    return network.double().requires_grad_(False)


def make(function, group, scene="random", size=16, **kwargs):
    """A small network; in float64 it runs dense whatever the backend."""
    hidden = 16 if size == 256 else 8
    generator = torch.Generator().manual_seed(11)
    return prepared(
        function(group, hidden=hidden, image_size=size, generator=generator, **kwargs), scene
    )
