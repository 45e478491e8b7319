"""The comparison with escnn is fair: same weights, same numbers, same update."""

import copy

import escnn.nn as enn
import escnn_reference as reference
import pytest
import torch
from torchrl.objectives import SoftUpdate

from equirl.modules import FieldType, SteerableConv, make_actor, make_critic
from equirl.modules.nonlinearity import make_activation
from equirl.objectives import SACLoss
from equirl.symmetry import SymmetryGroup
from tests.transitions import transitions

IMAGE = 32
GROUPS = ("C4", "C8", "D4", "D8", "SO2", "O2")
slow = pytest.mark.slow


def batch():
    return transitions(8, IMAGE)


def networks(group: str, backend: str, mode: str = "strict"):
    """Actor and critic as equirl builds them, with biases that are not zero."""
    size = {"hidden": 8, "image_size": IMAGE, "backend": backend, "mode": mode}
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


def both(group, backend, mode):
    """Our policy and critic, each with escnn's and with its inputs."""
    policy, critic = plain(*networks(group, backend, mode))
    data = batch()
    observation = data["depth"], data["holding"]
    return (
        (policy, reference.escnn_policy, observation),
        (critic, reference.escnn_critic, (*observation, data["action"])),
    )


#: Where several norms are largest escnn takes one of them, as mode "paper" does.
CASES = [(group, "dense", "paper") for group in GROUPS]
CASES += [(group, backend, "strict") for group in ("C4", "D4") for backend in ("dense", "auto")]


@pytest.mark.parametrize(("group", "backend", "mode"), CASES)
def test_escnn_networks_give_our_numbers(group, backend, mode):
    for ours, convert, inputs in both(group, backend, mode):
        theirs = convert(ours)
        torch.testing.assert_close(theirs(*inputs), ours(*inputs), atol=1e-5, rtol=1e-5)
        count = sum(parameter.numel() for parameter in ours.parameters())
        assert sum(parameter.numel() for parameter in theirs.parameters()) == count
        assert not any(isinstance(module, SteerableConv) for module in theirs.modules())


@pytest.mark.parametrize(
    "group", ["C4", "D4", "SO2", "O2", *(pytest.param(g, marks=slow) for g in ("C8", "D8"))]
)
def test_escnn_networks_have_our_gradients(group):
    for ours, convert, inputs in both(group, "dense", "paper"):
        theirs = convert(ours)
        outputs = [network(*inputs) for network in (ours, theirs)]
        outputs = [out if isinstance(out, tuple) else (out,) for out in outputs]
        towards = [torch.randn_like(out) for out in outputs[0]]
        for out in outputs:
            torch.autograd.backward(out, towards)
        # The conversion is linear: it takes our gradients to where escnn has its own.
        gradients = copy.deepcopy(ours)
        for parameter, original in zip(gradients.parameters(), ours.parameters(), strict=True):
            parameter.data.copy_(original.grad)
        pairs = zip(convert(gradients).parameters(), theirs.parameters(), strict=True)
        for expected, parameter in pairs:
            error = (parameter.grad - expected).norm() / expected.norm()
            # Rounding decides which of two nearly equal pixels gets a gradient.
            assert error < 0.02


@pytest.mark.parametrize("group", GROUPS)
def test_a_layer_with_its_activation_is_escnns(group):
    """Gates, which escnn hands out in another order, and their gradients."""
    torch.manual_seed(0)
    fields = FieldType.hidden(SymmetryGroup(group), 3)
    activation = make_activation(fields)
    ours = SteerableConv(fields, activation.in_type, padding=1)
    for parameter in (*ours.parameters(), *activation.parameters()):
        torch.nn.init.normal_(parameter, std=0.3)
    theirs = enn.SequentialModule(*reference.escnn_layer(ours, activation))
    x = torch.randn(2, fields.size, 6, 6, requires_grad=True)
    y, expected = activation(ours(x), dim=1), theirs(theirs.in_type(x)).tensor
    torch.testing.assert_close(y, expected, atol=1e-5, rtol=1e-5)
    towards = torch.randn_like(y)
    gradients = [torch.autograd.grad(out, x, towards)[0] for out in (y, expected)]
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)
    assert len(theirs) == 2  # and no pass that reorders channels


@pytest.mark.parametrize("group", ["SO2", "O2"])
def test_strict_networks_of_continuous_groups_can_be_compared_in_speed(group):
    """escnn does not share ties; everything else is there, and its updates train."""
    (policy, _, observation), (critic, *_) = both(group, "dense", "strict")
    theirs = reference.escnn_policy(policy)
    assert (theirs(*observation)[0] - policy(*observation)[0]).abs().max() > 1e-4
    pools = [m for m in theirs.modules() if isinstance(m, enn.NormMaxPool)]
    assert len(pools) == sum(not isinstance(p, torch.nn.Identity) for p in policy.encoder.pools)
    critics = (reference.escnn_critic(critic) for _ in range(2))
    losses = reference.TextbookSAC(theirs, *critics).update(batch())
    assert all(torch.tensor(loss).isfinite() for loss in losses.values())


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
