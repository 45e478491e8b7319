"""One gradient step, and the policy that is kept."""

import torch
from tensordict import TensorDict

from equirl.training import train
from equirl.training.learner import Learner
from tests.transitions import transitions


def batch() -> TensorDict:
    return transitions(4, 16)


def values(module) -> list[torch.Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def test_target_moves_by_tau_towards_the_critic_as_it_is_after_the_step(small_config):
    learner = Learner(small_config(algorithm={"tau": 0.25}))
    target = learner.loss.target_qvalue_network_params
    before = target.clone()
    learner.update(batch())
    expected = before.lerp(learner.loss.qvalue_network_params.data, 0.25)
    for key, value in target.items(True, True):
        torch.testing.assert_close(value, expected[key])
    assert any((value != before[key]).any() for key, value in target.items(True, True))


def test_every_trained_parameter_moves(small_config):
    learner = Learner(small_config())
    before = {name: p.detach().clone() for name, p in learner.loss.named_parameters()}
    learner.update(batch())
    learner.update(batch())
    for name, parameter in learner.loss.named_parameters():
        if not name.startswith("target"):
            assert not torch.equal(parameter, before[name]), name


def test_average_is_a_plain_mean_at_first_and_exponential_later(small_config):
    learner = Learner(small_config(algorithm={"averaging": 0.75}))
    history = []
    for _ in range(4):  # as many as weigh a quarter each
        learner.update(batch())
        history.append(values(learner.actor))
    means = [torch.stack(parameters).mean(0) for parameters in zip(*history, strict=True)]
    for ours, mean in zip(values(learner.policy), means, strict=True):
        torch.testing.assert_close(ours, mean)
    for _ in range(3):
        before = values(learner.policy)
        learner.update(batch())
        history.append(values(learner.actor))
        triples = zip(values(learner.policy), before, history[-1], strict=True)
        for ours, old, new in triples:
            torch.testing.assert_close(ours, 0.75 * old + 0.25 * new)
    assert learner.policy is not learner.actor
    assert any((a != b).any() for a, b in zip(values(learner.policy), history[-1], strict=True))


def test_without_averaging_the_actor_itself_is_kept(small_config):
    learner = Learner(small_config())
    assert learner.policy is learner.actor


def test_train_returns_the_evaluation_it_reports(tmp_path, small_config):
    evaluation = train(small_config(steps=4), tmp_path / "run")
    assert evaluation is not None and len(evaluation.episodes) == 2
    report = (tmp_path / "run" / "report.md").read_text()
    assert f"**{evaluation.success_rate:.0%} success** on 2 held-out scenes" in report
    assert train(small_config(steps=4), tmp_path / "run") == evaluation  # read, not played again
