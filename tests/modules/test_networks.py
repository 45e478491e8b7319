"""Actors and critics: parameter counts of the paper, keys, shapes, reproducibility, errors."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

from equirl.modules import (
    EquivariantEncoder,
    EquivariantQHeads,
    RadialTanhNormal,
    make_actor,
    make_cnn_actor,
    make_cnn_critic,
    make_critic,
    shared_filters,
)
from equirl.symmetry import ACTION, ACTION_PAPER
from tests.equivariance import assert_equivariant, turn_action, turn_image

SMALL = {"hidden": 8, "image_size": 16}
slow = pytest.mark.slow


def observations(*batch, size=16):
    return TensorDict(
        depth=0.3 * torch.rand(*batch, 1, size, size),
        holding=torch.randint(2, (*batch, 1)).float(),
        batch_size=batch,
    )


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("group", "actor", "critic"),
    [
        ("C4", 557_152, 590_170),
        ("C8", 1_113_184, 1_178_970),
        ("D4", 1_113_184, 1_178_970),
        ("D8", 2_225_248, 2_356_570),
        ("SO2", 1_394_336, 1_487_642),
        ("O2", 1_047_504, 1_133_322),
    ],
)
def test_parameter_counts_are_the_papers(group, actor, critic):
    assert count(make_actor(group, mode="paper")) == actor
    assert count(make_critic(group, mode="paper")) == critic


@pytest.mark.parametrize(
    ("group", "actor", "critic"),
    [
        ("C2", 279_071, 295_770),
        ("D2", 557_086, 590_170),
        ("C4", 557_087, 590_170),
        ("C8", 1_113_119, 1_178_970),
        ("D4", 1_113_118, 1_178_970),
        ("D8", 2_225_182, 2_356_570),
        ("SO2", 1_394_271, 1_487_642),
        ("O2", 1_047_438, 1_132_682),
    ],
)
def test_parameter_counts_of_strict_mode(group, actor, critic):
    # One log standard deviation (64 weights and a bias) fewer, and where there are
    # reflections no bias on theta, which changes its sign. O(2)'s critic reads theta into its
    # 2 x 64 sign fields, where the paper's reads an invariant into 128 trivial fields and the
    # 640 gates.
    assert count(make_actor(group)) == actor
    assert count(make_critic(group)) == critic


def test_parameter_counts_of_the_cnn():
    assert count(make_cnn_actor()) == 1_278_874
    assert count(make_cnn_critic()) == 1_312_146


def test_cnn_channels_are_the_papers_and_scale_with_hidden():
    def channels(**kwargs):
        return [layer.out_channels for layer in make_cnn_critic(**kwargs)[0].module.layers]

    assert channels() == [16, 32, 64, 128, 256, 256, 128]
    assert channels(hidden=16) == [4, 8, 16, 32, 64, 64, 32]
    assert channels(image_size=32) == [64, 128, 256, 256, 128]
    assert channels(image_size=256) == [8, 16, 32, 64, 128, 256, 256, 128]


def gated(group, **kwargs):
    kwargs = {"backend": "dense"} | kwargs
    return make_actor(group, **kwargs), make_critic(group, **kwargs)


MAKERS = {
    "strict": lambda **kw: (make_actor("D4", **kw), make_critic("D4", **kw)),
    "paper": lambda **kw: (
        make_actor("C4", mode="paper", **kw),
        make_critic("C4", mode="paper", **kw),
    ),
    "O2": lambda **kw: gated("O2", **kw),
    "paper SO2": lambda **kw: gated("SO2", mode="paper", **kw),
    "cnn": lambda **kw: (make_cnn_actor(**kw), make_cnn_critic(**kw)),
}


@pytest.fixture(params=MAKERS)
def networks(request):
    return MAKERS[request.param](**SMALL)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_keys_and_shapes_for_any_batch(networks, batch):
    actor, critic = networks
    assert isinstance(actor, ProbabilisticTensorDictSequential)
    assert set(actor.in_keys) == {"depth", "holding"}
    out = critic(actor(observations(*batch)))
    for key in ("loc", "scale", "action"):
        assert out[key].shape == (*batch, 5)
    assert out["action_log_prob"].shape == batch
    assert out["state_action_value"].shape == (*batch, 2)
    assert (out["scale"] > 0).all()


def test_batches_are_independent_of_their_shape(networks):
    actor, critic = networks
    data = critic(actor(observations(2, 3)))
    flat = critic(actor(data.select("depth", "holding").reshape(6)))
    one = critic(actor(data.select("depth", "holding")[1, 2]))
    for key in ("loc", "scale", "action", "state_action_value"):
        torch.testing.assert_close(flat[key].view_as(data[key]), data[key])
        torch.testing.assert_close(one[key], data[key][1, 2], atol=1e-5, rtol=1e-4)


def test_encoder_and_heads_can_be_called_apart(networks):
    actor, critic = networks
    data = actor(observations(3))
    features = critic[0](data.clone())
    assert critic[0].out_keys == ["_features"]
    assert critic[1].in_keys == ["_features", "action"]
    assert torch.equal(
        critic[1](features)["state_action_value"], critic(data)["state_action_value"]
    )


def test_acting_is_greedy_by_default_and_explores_on_request(networks):
    actor, data = networks[0], observations(4)
    greedy = actor(data.clone())["action"]
    assert torch.equal(greedy, actor.get_dist(data.clone()).deterministic_sample)
    assert torch.equal(greedy, actor(data.clone())["action"])
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(greedy, actor(data.clone())["action"])
    with set_exploration_type(ExplorationType.MEAN):
        assert torch.isfinite(actor(data.clone())["action"]).all()


def test_every_parameter_receives_a_gradient(networks):
    actor, critic = networks
    with shared_filters(), set_exploration_type(ExplorationType.RANDOM):
        data = critic(actor(observations(16)))
        (data["state_action_value"].sum() + data["action_log_prob"].sum()).backward()
    for name, parameter in (*actor.named_parameters(), *critic.named_parameters()):
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any(), name


def test_state_dict_is_parameters_only_in_either_mode(networks):
    for network in networks:
        names = {name for name, _ in network.named_parameters()}
        assert set(network.train().state_dict()) == names == set(network.eval().state_dict())


def test_pickle_deepcopy_and_float64(networks):
    actor, data = networks[0], observations(2)
    expected = actor(data.clone())["loc"]
    for other in (pickle.loads(pickle.dumps(actor)), copy.deepcopy(actor)):
        assert torch.equal(other(data.clone())["loc"], expected)
        precise = other.double()(data.clone().double())["loc"]
        assert precise.dtype == torch.float64
        torch.testing.assert_close(precise.float(), expected, atol=1e-5, rtol=1e-4)
    assert torch.equal(actor(data.clone())["loc"], expected)


def test_networks_export(networks):
    actor, critic = networks
    policy, data = actor.module[0].module, observations(3)
    inputs = (data["depth"], data["holding"])
    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(policy, inputs, dynamic_shapes=({0: batch}, {0: batch}))
    torch.testing.assert_close(program.module()(*inputs), policy(*inputs))
    more = observations(5)
    assert program.module()(more["depth"], more["holding"])[0].shape == (5, 5)
    features = critic[0].module(*inputs).detach()
    heads = critic[1].module
    exported = torch.export.export(heads, (features, torch.rand(3, 5))).module()
    action = torch.rand(3, 5)
    torch.testing.assert_close(exported(features, action), heads(features, action))


def test_generators_make_networks_reproducible():
    for make in MAKERS.values():
        first, second, third = (
            make(**SMALL, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
        )
        for a, b, c in zip(*(n.parameters() for n in (first[1], second[1], third[1])), strict=True):
            assert torch.equal(a, b)
            assert (a == a.flatten()[0]).all() or not torch.equal(a, c)  # biases are constant


def test_modes_choose_the_distribution_and_the_deviations():
    strict, paper = make_actor("D4", **SMALL), make_actor("D4", mode="paper", **SMALL)
    data = observations(3)
    assert isinstance(strict.get_dist(data.clone()), RadialTanhNormal)
    assert isinstance(paper.get_dist(data.clone()), TanhNormal)
    shared = strict(data.clone())["scale"]
    assert torch.equal(shared[:, 1], shared[:, 2])
    assert not torch.equal(*paper(data.clone())["scale"][:, 1:3].unbind(-1))
    assert strict.module[0].module.out_rep == ACTION
    assert paper.module[0].module.out_rep == ACTION_PAPER


def test_deviations_are_clamped():
    actor = make_actor("D4", **SMALL)
    with torch.no_grad():
        actor.module[0].module.head.weights.mul_(1e6)
    scale = actor(observations(32))["scale"].log()
    assert scale.min() >= -20 - 1e-4
    assert scale.max() <= 2 + 1e-4


def test_any_number_of_heads():
    assert make_critic("C4", heads=3, **SMALL)(make_actor("C4", **SMALL)(observations(2)))[
        "state_action_value"
    ].shape == (2, 3)
    with pytest.raises(ValueError, match="heads=0"):
        EquivariantQHeads(EquivariantEncoder("C4", **SMALL).out_type, heads=0)


@pytest.mark.parametrize("size", [16, 32, 64, *(pytest.param(s, marks=slow) for s in (128, 256))])
@pytest.mark.parametrize("cnn", [False, True], ids=["equivariant", "cnn"])
def test_every_image_size(size, cnn):
    kwargs = {"hidden": 16 if size == 256 else 8, "image_size": size}
    actor = make_cnn_actor(**kwargs) if cnn else make_actor("D4", **kwargs)
    critic = make_cnn_critic(**kwargs) if cnn else make_critic("D4", **kwargs)
    with torch.no_grad():
        out = critic(actor(observations(1, size=size)))
    assert out["state_action_value"].shape == (1, 2)


@pytest.mark.parametrize("make", [make_actor, make_critic])
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"image_size": 100}, "image_size=100 .* 16, 32, 64, 128, 256"),
        ({"image_size": 8}, "image_size=8 "),
        ({"hidden": 12}, "hidden=12 .* multiple of 8"),
        ({"hidden": 8, "image_size": 256}, "hidden=8 .* multiple of 16"),
        ({"hidden": 0}, "hidden=0"),
        ({"hidden": 8.0}, "hidden=8.0"),
        ({"mode": "exact"}, "mode='exact': expected one of strict, paper"),
    ],
)
def test_bad_arguments_are_refused(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make("D4", **(SMALL | kwargs))


@pytest.mark.parametrize("make", [make_actor, make_critic])
@pytest.mark.parametrize("group", ["SO3", "O", "E4"])
def test_bad_groups_are_refused(make, group):
    with pytest.raises(ValueError, match=f"unknown symmetry group '{group}'"):
        make(group, **SMALL)


def test_wrong_observation_shapes_are_refused():
    actor = make_actor("C4", **SMALL)
    policy = actor.module[0].module
    with pytest.raises(ValueError, match=r"image \(\*batch, 1, 16, 16\).*got \(2, 1, 32, 32\)"):
        policy(torch.rand(2, 1, 32, 32), torch.ones(2, 1))
    for invariants in (torch.ones(3, 1), torch.ones(2, 3), torch.ones(2), None):
        with pytest.raises(ValueError, match=r"invariants \(\*batch, 1\), got \(2, 1, 16, 16\)"):
            policy(torch.rand(2, 1, 16, 16), invariants)


def test_wider_heads_leave_the_encoder_alone_and_values_invariant():
    generator = torch.Generator().manual_seed(0)
    critic = make_critic("D4", **SMALL, head_width=24, generator=generator)
    assert count(critic[0]) == count(make_critic("D4", **SMALL)[0])
    assert critic[1].module.hidden.out_type.size == 2 * 24 * 8
    critic.double()
    assert_equivariant(
        lambda **inputs: {"values": critic(TensorDict(inputs, 3))["state_action_value"]},
        "D4",
        {**observations(3).double(), "action": torch.rand(3, 5).double()},
        {"depth": turn_image, "action": turn_action},
        case="wide critic",
    )
    with pytest.raises(ValueError, match="width of the heads, 0: expected a positive integer"):
        make_critic("D4", **SMALL, head_width=0)
