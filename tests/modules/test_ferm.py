"""FERM's networks: sizes, tied convolutions, distribution."""

import copy
from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from equirl.modules import (
    FERMEncoder,
    make_cnn_critic,
    make_ferm_actor,
    make_ferm_critic,
    tie_convolutions,
)
from equirl.objectives import SACLoss
from tests.transitions import transitions

SMALL = {"hidden": 8, "image_size": 16}


def networks(seed=1):
    generator = torch.Generator().manual_seed(seed)
    return (
        make_ferm_actor(**SMALL, generator=generator),
        make_ferm_critic(**SMALL, generator=generator),
    )


def convolutions(network):
    """The convolutions' parameters, found by their shape: filters, and the bias of each."""
    layers = [layer for layer in network.modules() if isinstance(layer, torch.nn.Conv2d)]
    return [parameter for layer in layers for parameter in (layer.weight, layer.bias)]


def observations(count, size=18):
    return TensorDict(
        depth=0.3 * torch.rand(count, 1, size, size),
        holding=torch.randint(2, (count, 1)).float(),
        batch_size=[count],
    )


def test_parameter_counts_are_those_of_figure_8():
    def affine(into, out):
        return into * out + out

    channels = [2, 16, 32, 64, 128, 256, 256, 1024]
    stack = sum(affine(9 * into, out) for into, out in pairwise(channels))
    encoder = stack + affine(1024, 50) + 2 * 50
    head = affine(50 + 5, 1024) + affine(1024, 1024) + affine(1024, 1)
    branch = affine(50, 1024) + affine(1024, 1024) + affine(1024, 5)
    for network, expected in (
        (make_ferm_critic(), encoder + 2 * head),
        (make_ferm_actor(), encoder + 2 * branch),
    ):
        assert sum(parameter.numel() for parameter in network.parameters()) == expected


def test_widths_scale_with_hidden_and_the_features_do_not():
    critic = make_ferm_critic(hidden=16, image_size=32)
    encoder = critic.module[0].module.encoder
    stack = [layer.out_channels for layer in encoder.convolutions.layers]
    assert stack == [16, 32, 64, 64, 256]
    assert encoder.linear.out_features == 50
    widths = [layer.weight.shape for layer in critic.module[1].module.heads[0][::2]]
    assert widths == [(256, 55), (256, 256), (1, 256)]
    with pytest.raises(ValueError, match=r"hidden=12 .* multiple of 8"):
        FERMEncoder(hidden=12, image_size=16)


def test_features_are_a_layer_norm_of_a_linear_map():
    critic, data = networks()[1], observations(4, size=16)
    encoder = critic.module[0].module.encoder
    x = encoder.convolutions(data["depth"], data["holding"])
    assert (x >= 0).all()  # ReLUs, the last layer's too
    x = x @ encoder.linear.weight.T + encoder.linear.bias
    x = x - x.mean(-1, keepdim=True)
    expected = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt()
    features = critic.module[0](data)["_features"]
    assert features.shape == (4, 50)
    torch.testing.assert_close(features, expected, atol=1e-5, rtol=1e-4)


def test_log_probabilities_are_finite_however_large_the_outputs():
    actor, _ = networks()
    policy = actor.module[0].module
    for factor in (1.0, 1e6):
        with torch.no_grad():
            for branch in (policy.loc, policy.log_std):
                branch[-1].weight.mul_(factor)
        with set_exploration_type(ExplorationType.RANDOM):
            data = actor(observations(32))
        assert torch.isfinite(data["action_log_prob"]).all()
        assert data["action"].abs().max() <= 1
        scale = data["scale"].log()
        assert scale.min() >= -20 - 1e-4 and scale.max() <= 2 + 1e-4


def test_generators_make_networks_reproducible():
    for first, second, other in zip(networks(1), networks(1), networks(2), strict=True):
        for a, b in zip(first.parameters(), second.parameters(), strict=True):
            assert torch.equal(a, b)
        filters = [convolutions(network)[::2] for network in (first, other)]
        assert not any(torch.equal(a, b) for a, b in zip(*filters, strict=True))


@pytest.mark.parametrize("which", [0, 1], ids=["actor", "critic"])
def test_state_dict_is_parameters_only_and_restores_the_network(which):
    first, second = networks(1)[which], networks(2)[which]
    assert set(first.state_dict()) == {name for name, _ in first.named_parameters()}
    second.load_state_dict(first.state_dict())
    data = observations(3).set("action", torch.rand(3, 5))
    key = ("loc", "state_action_value")[which]
    assert torch.equal(first(data.clone())[key], second(data.clone())[key])


def test_the_actor_is_tied_to_the_critics_convolutions_alone():
    actor, critic = networks()
    before = copy.deepcopy(dict(actor.named_parameters()))
    critics = copy.deepcopy(list(critic.parameters()))
    tie_convolutions(actor, critic)
    for ours, theirs in zip(convolutions(actor), convolutions(critic), strict=True):
        assert ours is not theirs and torch.equal(ours, theirs)
        assert ours.data_ptr() != theirs.data_ptr()
        assert not ours.requires_grad and theirs.requires_grad
    for name, parameter in actor.named_parameters():
        if "convolutions" not in name:
            assert torch.equal(parameter, before[name]), name
    for parameter, expected in zip(critic.parameters(), critics, strict=True):
        assert torch.equal(parameter, expected)


def test_the_actors_loss_leaves_the_convolutions_alone():
    """Its own linear layer, norm and perceptrons learn; both stacks of convolutions do not."""
    actor, critic = networks()
    tie_convolutions(actor, critic)
    loss = SACLoss(actor, critic)
    SoftUpdate(loss, tau=0.01)
    losses = loss(transitions(8, 16))
    losses["loss_actor"].backward()
    for name, parameter in actor.named_parameters():
        if "convolutions" in name:
            assert parameter.grad is None, name
        else:
            assert parameter.grad.any(), name
    assert all(parameter.grad is None for parameter in critic.parameters())
    loss(transitions(8, 16))["loss_qvalue"].backward()
    assert all(parameter.grad.any() for parameter in convolutions(critic))


def test_training_moves_the_tied_convolutions_of_both():
    """As the learner does: one optimiser of all the loss's parameters, then the tie."""
    actor, critic = networks()
    tie_convolutions(actor, critic)
    loss = SACLoss(actor, critic)
    target = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    data, before = transitions(8, 16), copy.deepcopy(convolutions(actor))
    start = actor(data.clone())["loc"]
    for _ in range(2):
        optimizer.zero_grad(set_to_none=True)
        loss.backward(data.clone())
        optimizer.step()
        target.step()
        tie_convolutions(actor, critic)
    pairs = zip(convolutions(actor), convolutions(critic), before, strict=True)
    for ours, theirs, old in pairs:
        assert torch.equal(ours, theirs)
        assert not torch.equal(ours, old)
    assert not torch.equal(actor(data.clone())["loc"], start)
    # What the loss sees of the actor is what acts.
    seen = loss.actor_network_params["module", "0", "module", "encoder", "encoder", "convolutions"]
    for index, (ours, expected) in enumerate(
        zip(convolutions(actor)[::2], convolutions(critic)[::2], strict=True)
    ):
        assert seen["layers", str(index), "weight"] is ours
        assert torch.equal(seen["layers", str(index), "weight"], expected)


def test_networks_of_other_methods_cannot_be_tied():
    actor, _ = networks()
    with pytest.raises(TypeError, match="one FERMEncoder, got a TensorDictSequential that holds 0"):
        tie_convolutions(actor, make_cnn_critic(**SMALL))
