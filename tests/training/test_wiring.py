"""What a configuration says is what is built and done."""

import copy

import pytest
import torch

from equirl.config import ConfigError
from equirl.data import (
    ProtectingWriter,
    RandomCrop,
    RandomRotation,
    RotationAugmentation,
    SymmetricSampler,
)
from equirl.objectives import DrQfDLoss, DrQLoss, EquivarianceLoss, SACfDLoss, SACLoss
from equirl.training.learner import Learner
from equirl.training.networks import make_networks
from equirl.training.replay import make_priorities, make_run_buffer
from tests.training.runs import run
from tests.transitions import transitions


def buffer_of(config):
    return make_run_buffer(config, 0.32, torch.Generator().manual_seed(0))


def transforms(buffer) -> dict:
    """The transforms of sampled batches by their kinds, in order."""
    return {type(each): each for each in buffer._transform}


def batch(learner: Learner, count: int = 4):
    """Transitions such as the run's buffer would give, the last one an expert's."""
    data = transitions(count, 16)
    data["expert"][-1] = True
    if learner.representation:
        data["positive"] = transitions(count, 16, seed=1)["depth"]
    return data


@pytest.mark.parametrize(
    ("augmentation", "copies", "online", "exact"),
    [
        ({"name": "buffer", "copies": 3}, 3, False, False),
        ({"name": "buffer", "copies": 2, "quarter_turns": True}, 2, False, True),
        ({"name": "online"}, 0, True, False),
        ({"name": "online", "quarter_turns": True}, 0, True, True),
        ({"name": "auxiliary"}, 0, False, False),
        ({"name": "none"}, 0, False, False),
    ],
)
def test_augmentations_in_the_buffer(small_config, augmentation, copies, online, exact):
    found = transforms(buffer_of(small_config(augmentation=augmentation)))
    assert found[RotationAugmentation].copies == copies
    assert (RandomRotation in found) == online
    turning = found[RandomRotation] if online else found[RotationAugmentation]
    assert turning.quarter_turns == exact or not (copies or online)


@pytest.mark.parametrize(("method", "positives"), [("cnn", None), ("rad", False), ("ferm", True)])
def test_crops_come_last_and_see_what_is_asked(small_config, method, positives):
    config = small_config(method={"name": method}, augmentation={"name": "online"})
    found = transforms(buffer_of(config))
    if positives is None:
        assert RandomCrop not in found
    else:
        assert list(found)[-2:] == [RandomRotation, RandomCrop]
        assert (found[RandomCrop].size, found[RandomCrop].positives) == (16, positives)


@pytest.mark.parametrize(("method", "size"), [("rad", 18), ("ferm", 18), ("drq", 16)])
def test_learners_see_random_crops_of_what_the_environment_shows(
    tmp_path, small_config, monkeypatch, method, size
):
    seen = []

    def noted(learner, batch):
        seen.append(batch.clone())
        return dict.fromkeys(learner.metric_names, 0.0)

    monkeypatch.setattr(Learner, "update", noted)
    config = small_config(
        method={"name": method, "pretraining": 0}, augmentation={"name": "none"}, steps=30,
        replay={"start": 2},
    )  # fmt: skip
    training = run(config, tmp_path)
    stored = training.buffer.storage[:]["depth"]
    assert stored.shape[-1] == size
    assert {each["depth"].shape[-1] for each in seen} == {16}
    versions = {}
    for each in seen:
        for row, image in zip(each["index"].tolist(), each["depth"], strict=True):
            versions.setdefault(row, set()).add(image.numpy().tobytes())
    assert (max(map(len, versions.values())) > 1) == (size == 18)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"algorithm": {"name": "sac"}}, SACLoss),
        ({"algorithm": {"name": "sacfd", "demonstration_weight": 2.0}}, SACfDLoss),
        ({"method": {"name": "drq", "target_views": 3, "loss_views": 1, "shift": 5}}, DrQLoss),
        ({"method": {"name": "drq"}, "algorithm": {"name": "sacfd"}}, DrQfDLoss),
    ],
)
def test_losses_and_their_numbers(small_config, changes, kind):
    algorithm = {"alpha": 0.02, "target_entropy": -3.0, "critics": 3}
    config = small_config(**changes | {"algorithm": algorithm | changes.get("algorithm", {})})
    learner = Learner(config)
    loss = learner.loss
    assert type(loss) is kind
    assert loss.log_alpha.exp().item() == pytest.approx(0.02)
    assert loss.target_entropy.item() == -3
    if isinstance(loss, SACfDLoss):
        assert loss.demonstration_weight == config.algorithm.demonstration_weight
    if isinstance(loss, DrQLoss):
        asked = config.method
        assert (loss.target_views, loss.loss_views) == (asked.target_views, asked.loss_views)
        assert loss.shift == (asked.shift or 1)
    _, critic = make_networks(config)
    values = critic(transitions(2, 16))["state_action_value"]
    assert values.shape == (2, 3)


@pytest.mark.parametrize(
    ("mode", "asked", "applied"),
    [
        ("strict", "auto", True),
        ("paper", "auto", False),
        ("strict", "drop", False),
        ("paper", "apply", True),
    ],
)
def test_importance_weights(small_config, mode, asked, applied):
    replay = {"importance_weights": asked, "exponent": 0.7, "expert_bonus": 2.0, "beta": 0.5}
    config = small_config(mode=mode, algorithm={"name": "sacfd"}, replay=replay)
    assert Learner(config).loss.importance_weights == applied
    priorities = make_priorities(config)
    assert (priorities.exponent, priorities.bonus, priorities.beta) == (0.7, 2.0, 0.5)
    assert "priority_weight" in sampled(buffer_of(config))


def sampled(buffer):
    buffer.extend(transitions(6, 16))
    return buffer.sample()


@pytest.mark.parametrize("sampling", ["uniform", "symmetric"])
def test_what_batches_are_made_of(tmp_path, small_config, monkeypatch, sampling):
    experts = []

    def noted(learner, batch):
        experts.append(int(batch["expert"].sum()))
        return dict.fromkeys(learner.metric_names, 0.0)

    monkeypatch.setattr(Learner, "update", noted)
    config = small_config(
        replay={"sampling": sampling, "start": 2}, demos={"episodes": 2}, steps=40,
        augmentation={"name": "none"},
    )  # fmt: skip
    buffer = run(config, tmp_path).buffer
    assert isinstance(buffer.sampler, SymmetricSampler) == (sampling == "symmetric")
    assert (buffer.writer.protected > 0) == (sampling == "symmetric")
    assert isinstance(buffer.writer, ProtectingWriter)
    assert (set(experts) == {2}) == (sampling == "symmetric")


@pytest.mark.parametrize("exact", [False, True])
def test_the_auxiliary_loss_is_part_of_the_gradient(small_config, exact):
    augmentation = {"name": "auxiliary", "weight": 30.0, "quarter_turns": exact}
    changes = {"method": {"name": "cnn"}, "algorithm": {"alpha": 1e-3}}
    with_it = Learner(small_config(**changes, augmentation=augmentation))
    without = Learner(small_config(**changes, augmentation={"name": "none"}))
    assert isinstance(with_it.auxiliary, EquivarianceLoss) and without.auxiliary is None
    assert (with_it.auxiliary.weight, with_it.auxiliary.quarter_turns) == (30.0, exact)
    copies = copy.deepcopy((without.actor, without.critic))
    expected = EquivarianceLoss(
        *copies, weight=30.0, quarter_turns=exact, generator=torch.Generator()
    )
    expected.generator.set_state(with_it.generator.get_state())
    sum(expected(batch(with_it)).values()).backward()
    for learner in (with_it, without):
        torch.manual_seed(0)
        learner.optimizer.step = lambda: None  # the gradients stay, and so what they are of
        learner.update(batch(learner))
    for part in (0, 1):
        learners = ((each.actor, each.critic)[part] for each in (with_it, without))
        parameters = (module.named_parameters() for module in (*learners, copies[part]))
        for (name, both), (_, plain), (_, term) in zip(*parameters, strict=True):
            added = torch.zeros_like(plain) if term.grad is None else term.grad
            torch.testing.assert_close(both.grad, plain.grad + added, msg=name)
        assert any(
            not torch.equal(p.grad, torch.zeros_like(p))
            for p in copies[part].parameters()
            if p.grad is not None
        )


def test_ferms_key_encoder_moves_by_its_momentum(small_config):
    learner = Learner(small_config(method={"name": "ferm", "momentum": 0.25}))
    loss = learner.representation.loss
    before = loss.target_encoder_params.clone()
    learner.update(batch(learner))
    expected = before.lerp(loss.encoder_params.data, 0.25)
    moved = 0
    for key, value in loss.target_encoder_params.items(True, True):
        torch.testing.assert_close(value, expected[key])
        moved += not torch.equal(value, before[key])
    assert moved > 10


def test_demonstrations_that_fill_their_buffer_are_refused(tmp_path, small_config):
    config = small_config(
        algorithm={"name": "sacfd"}, replay={"capacity": 60, "start": 10}, demos={"episodes": 3}
    )
    with pytest.raises(ConfigError, match=r"replay.capacity=60: no room is left .* 4 copies"):
        run(config, tmp_path)


def test_several_updates_a_step_go_on_when_nothing_moves(tmp_path, small_config):
    """Filters that stay the same, of which a second update must not use the first one's graph."""
    config = small_config(
        algorithm={"updates": 2, "learning_rate": 1e-20}, replay={"start": 10}, steps=3
    )
    assert run(config, tmp_path).step == 3
