"""The auxiliary equivariance loss, against plain rotations."""

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from equirl.modules import make_actor, make_critic, shared_filters
from equirl.objectives import EquivarianceLoss, SACLoss
from tests.objectives.plain import (
    BATCH,
    LOSSES,
    SIZE,
    assert_same_gradients,
    assert_same_losses,
    batch,
    judge,
    networks,
)
from tests.transitions import transitions


def plain_turn(images, actions, angles):
    """Turns images by sampling where each pixel came from, and (x, y) by the usual matrix.

    Columns grow with y, rows with x: what affine_grid calls x is y here.
    """
    matrices = torch.stack(
        [
            torch.stack([angles.cos(), -angles.sin(), torch.zeros_like(angles)], -1),
            torch.stack([angles.sin(), angles.cos(), torch.zeros_like(angles)], -1),
        ],
        1,
    )
    grid = F.affine_grid(matrices, list(images.shape), align_corners=False)
    turned = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    x, y = actions[:, 1], actions[:, 2]
    moved = angles.cos() * x - angles.sin() * y, angles.sin() * x + angles.cos() * y
    return turned, torch.stack([actions[:, 0], *moved, actions[:, 3], actions[:, 4]], -1)


def plain_losses(actor, critic, data, angles, weight):
    seen, action = plain_turn(data["depth"], data["action"], angles)

    def greedy(depth):
        observed = TensorDict({"depth": depth, "holding": data["holding"]}, [BATCH])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(observed)["action"]

    _, expected = plain_turn(data["depth"], greedy(data["depth"]), angles)
    there = judge(critic, seen, data["holding"], action)
    here = judge(critic, data["depth"], data["holding"], data["action"])
    return {
        "loss_actor_equivariance": weight / 2 * ((greedy(seen) - expected) ** 2).mean(),
        "loss_critic_equivariance": weight / 2 * ((there - here) ** 2).mean(),
    }


@pytest.mark.parametrize("weight", [1.0, 0.3])
@pytest.mark.parametrize("quarter_turns", [False, True])
def test_equals_a_plain_computation(weight, quarter_turns):
    ours, plain = networks()
    generator = torch.Generator().manual_seed(3)
    options = {"weight": weight, "quarter_turns": quarter_turns}
    loss = EquivarianceLoss(*ours, **options, generator=torch.Generator().manual_seed(3))
    if quarter_turns:
        angles = torch.randint(4, (BATCH,), generator=generator).double() * math.pi / 2
    else:
        angles = math.tau * torch.rand(BATCH, generator=generator).double()
    data = batch()
    losses = loss(data)
    sum(losses.values()).backward()
    expected = plain_losses(*plain, batch(), angles, weight)
    sum(expected.values()).backward()
    assert_same_losses(losses, expected)
    assert all(value > 1e-6 for value in losses.values())  # a plain network lacks the symmetry
    for name, p in ours[0].named_parameters():
        assert (p.grad is None or not p.grad.any()) == ("log_std" in name), name
    for module in (*ours, *plain):  # the deviations, and biases of Q that cancel in a difference
        for p in module.parameters():
            if p.grad is None or p.grad.abs().max() < 1e-12:
                p.grad = torch.ones_like(p)
    assert_same_gradients(ours, plain)
    assert data.keys() == batch().keys()


def test_an_equivariant_network_has_nothing_to_learn_from_quarter_turns():
    generator = torch.Generator().manual_seed(1)
    size = {"hidden": 8, "image_size": SIZE, "generator": generator}
    nets = make_actor("D4", **size).double(), make_critic("D4", **size).double()
    exact = EquivarianceLoss(*nets, quarter_turns=True)(batch())
    assert all(value < 1e-18 for value in exact.values())
    turned = EquivarianceLoss(*nets)(batch())
    assert all(value > 1e-12 for value in turned.values())


def test_it_trains_the_parameters_of_the_loss_beside_it():
    (actor, critic), _ = networks()
    sac = SACLoss(actor, critic, **LOSSES)
    loss = EquivarianceLoss(actor, critic, quarter_turns=True)
    trained = {id(p) for p in sac.parameters()}
    mine = list(loss.parameters())
    assert mine and all(id(p) in trained for p in mine)
    optimizer = torch.optim.SGD(sac.parameters(), lr=0.05)
    values = []
    for _ in range(30):
        loss.generator = torch.Generator().manual_seed(0)
        losses = loss(batch())
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
        values.append(sum(losses.values()).item())
    assert values[-1] < 0.5 * values[0]


def test_it_goes_beside_a_loss_that_was_differentiated_before():
    """Networks with filters of their own, which losses of one update share."""
    generator = torch.Generator().manual_seed(1)
    size = {"hidden": 8, "image_size": SIZE, "generator": generator}
    actor, critic = make_actor("C4", **size), make_critic("C4", **size)
    alone = copy.deepcopy((actor, critic))
    sac = SACLoss(actor, critic, **LOSSES)
    SoftUpdate(sac, tau=0.1)
    data = transitions(BATCH, SIZE)
    with shared_filters():
        sac.backward(data.clone())
        sac.zero_grad()
        together = EquivarianceLoss(actor, critic, generator=torch.Generator())(data)
        sum(together.values()).backward()
    sum(EquivarianceLoss(*alone, generator=torch.Generator())(data).values()).backward()
    for ours, expected in zip((actor, critic), alone, strict=True):
        for p, q in zip(ours.parameters(), expected.parameters(), strict=True):
            torch.testing.assert_close(p.grad, q.grad)


def test_a_weight_that_is_none_is_refused():
    (actor, critic), _ = networks()
    with pytest.raises(ValueError, match=r"weight=nan: expected a number of 0 or more"):
        EquivarianceLoss(actor, critic, weight=math.nan)
