"""The comparison with escnn is fair: same weights, same numbers, same update."""

import copy

import escnn_reference as reference
import pytest
import torch
from torchrl.objectives import SoftUpdate

from equirl.modules import make_actor, make_critic
from equirl.objectives import SACLoss
from tests.transitions import transitions

IMAGE = 32


def batch():
    return transitions(8, IMAGE)


def networks(group: str, backend: str):
    """Actor and critic as equirl builds them, with biases that are not zero."""
    size = {"hidden": 8, "image_size": IMAGE, "backend": backend}
    size["generator"] = torch.Generator().manual_seed(1)
    actor, critic = make_actor(group, **size), make_critic(group, **size)
    torch.manual_seed(2)
    with torch.no_grad():
        for name, parameter in [*actor.named_parameters(), *critic.named_parameters()]:
            if name.endswith("bias"):
                parameter.normal_(std=0.1)
    return actor, critic


def plain(actor, critic):
    """The modules inside."""
    return actor.module[0].module, reference.Critic(critic[0].module, critic[1].module)


@pytest.mark.parametrize("backend", ["dense", "auto"])
@pytest.mark.parametrize("group", ["C4", "D4"])
def test_escnn_networks_give_our_numbers(group, backend):
    policy, critic = plain(*networks(group, backend))
    data = batch()
    observation = data["depth"], data["holding"]
    for ours, theirs, inputs in (
        (policy, reference.escnn_policy(policy), observation),
        (critic, reference.escnn_critic(critic), (*observation, data["action"])),
    ):
        torch.testing.assert_close(theirs(*inputs), ours(*inputs), atol=1e-5, rtol=1e-5)
        count = sum(parameter.numel() for parameter in ours.parameters())
        assert sum(parameter.numel() for parameter in theirs.parameters()) == count


@pytest.mark.parametrize("backend", ["dense", "auto"])
@pytest.mark.parametrize("group", ["C4", "D4"])
def test_one_textbook_update_is_the_same_with_either_and_with_our_loss(group, backend):
    actor, critic = networks(group, backend)
    loss = SACLoss(*copy.deepcopy((actor, critic)))
    SoftUpdate(loss, tau=0.01)
    policy, critic = plain(actor, critic)
    escnn = reference.TextbookSAC(
        reference.escnn_policy(policy),
        reference.escnn_critic(critic),
        reference.escnn_critic(critic),
    )
    ours = reference.TextbookSAC(policy, critic, copy.deepcopy(critic))
    torch.manual_seed(3)
    expected = {key: value.item() for key, value in loss(batch()).items() if "loss" in key}
    for sac in (ours, escnn):
        torch.manual_seed(3)
        assert sac.update(batch()) == pytest.approx(expected, rel=1e-4, abs=1e-5)
    data = batch()
    torch.manual_seed(4)
    second = ours.update(data)
    torch.manual_seed(4)
    assert escnn.update(data) == pytest.approx(second, rel=2e-2, abs=1e-3)
    assert second != pytest.approx(expected, rel=1e-2)
