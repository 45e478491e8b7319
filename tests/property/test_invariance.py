"""What else must not matter: how a batch is turned, to the gradients; its order; its company."""

import pytest
import torch

from equirl.modules import make_actor, make_critic
from tests.equivariance import grid_elements, turn_action, turn_action_of_the_paper, turn_image
from tests.property.scenes import CONTINUOUS, GROUPS, SCENES, actions, make, scenes

TURN_ACTION = {"strict": turn_action, "paper": turn_action_of_the_paper}
MODES = tuple(TURN_ACTION)


def networks(group, mode):
    """Policy, encoder of the critic, and heads."""
    actor, critic = (make(each, group, mode=mode) for each in (make_actor, make_critic))
    return torch.nn.ModuleList(
        (actor.module[0].module, critic[0].module, critic[1].module)
    ).requires_grad_()


def outputs(networks, depth, holding, action):
    policy, encoder, heads = networks
    return *policy(depth, holding), heads(encoder(depth, holding), action)


def loss_and_gradients(networks, mode, inputs, element):
    """Of an invariant loss, for turned inputs; gradients of images, actions, parameters."""
    generator = torch.Generator().manual_seed(2)
    turn = TURN_ACTION[mode]
    depth = turn_image(inputs["depth"], *element).requires_grad_()
    action = turn(inputs["action"], *element).requires_grad_()
    loc, scale, values = outputs(networks, depth, inputs["holding"], action)
    towards, weights, more = (
        torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in (loc, scale, values)
    )
    loss = (loc * turn(towards, *element)).sum() + (scale * weights).sum() + (values * more).sum()
    parameters = list(networks.parameters())
    return loss, *torch.autograd.grad(loss, [depth, action, *parameters])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("group", GROUPS)
def test_gradients_turn_with_the_batch_and_those_of_parameters_stay(group, mode):
    nets = networks(group, mode)
    inputs = {**scenes("random", 16), "action": actions()}
    loss, depth, action, *parameters = loss_and_gradients(nets, mode, inputs, (0, False))
    assert depth.abs().min() > 0 and action.abs().min() > 0
    assert all(gradient.any() for gradient in parameters)
    for element in grid_elements(group)[1:]:
        turned = loss_and_gradients(nets, mode, inputs, element)
        expected = (
            loss,
            turn_image(depth, *element),
            TURN_ACTION[mode](action, *element),
            *parameters,
        )
        for ours, value in zip(turned, expected, strict=True):
            torch.testing.assert_close(ours, value, atol=1e-9, rtol=0)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", CONTINUOUS)
def test_gradients_of_symmetric_scenes_are_symmetric(group, scene):
    """Shares of ties are smooth in the image, where the first of them has all of the gradient."""
    nets = networks(group, "strict")
    inputs = {**scenes(scene, 16), "action": actions()}
    first, *_ = grid_elements(group)
    _, depth, action, *parameters = loss_and_gradients(nets, "strict", inputs, first)
    for element in grid_elements(group)[1:]:
        _, *turned = loss_and_gradients(nets, "strict", inputs, element)
        expected = (turn_image(depth, *element), turn_action(action, *element), *parameters)
        for ours, value in zip(turned, expected, strict=True):
            assert torch.isfinite(value).all()
            torch.testing.assert_close(ours, value, atol=1e-9, rtol=0)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("group", GROUPS)
def test_the_order_of_a_batch_and_its_company_do_not_matter(group, mode):
    nets = networks(group, mode)
    together = torch.cat([scenes(scene, 16) for scene in SCENES])
    together["action"] = actions(batch=len(together))
    with torch.no_grad():
        expected = outputs(nets, **together)
        order = torch.randperm(len(together), generator=torch.Generator().manual_seed(1))
        some = torch.tensor([4])
        for chosen in (order, order[:7], some):
            for ours, value in zip(outputs(nets, **together[chosen]), expected, strict=True):
                torch.testing.assert_close(ours, value[chosen], atol=1e-12, rtol=0)


@pytest.mark.parametrize("group", ["D4", "SO2", "O2"])
def test_an_image_that_is_not_a_number_spoils_no_other(group):
    policy, data = networks(group, "strict")[0], scenes("random", 16)
    with torch.no_grad():
        expected = policy(*data.values())
        data["depth"][1, 0, 3, 3] = float("nan")
        for ours, value in zip(policy(*data.values()), expected, strict=True):
            assert ours[1].isnan().any()
            torch.testing.assert_close(ours[[0, 2]], value[[0, 2]], atol=1e-12, rtol=0)
