"""Every method, algorithm and augmentation in the one loop; each resumed exactly."""

import itertools

import pytest
import torch

from equirl.modules import METHODS
from equirl.training import CHECKPOINT, load_checkpoint
from equirl.training.demonstrations import record_demonstrations
from tests.training.runs import assert_same, assert_same_run, run

#: Updates from the first steps on, whatever the augmentation.
EARLY = {"replay": {"start": 10}, "method": {"pretraining": 5}}


def methods(**changes):
    """The changes that make a small run of a method, an algorithm and more."""
    return {key: EARLY.get(key, {}) | value for key, value in (EARLY | changes).items()}


@pytest.mark.parametrize(
    ("method", "algorithm"),
    itertools.product(METHODS, ("sac", "sacfd")),
)
def test_each_method_is_resumed_exactly(tmp_path, small_config, method, algorithm):
    config = small_config(**methods(method={"name": method}, algorithm={"name": algorithm}))
    whole = run(config, tmp_path / "whole")
    for stop in (6, 17):
        run(config, tmp_path / "parts", stop_after=stop)
    run(config, tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")
    names = ["loss_qvalue", "loss_actor"]
    names += ["loss_demonstration"] if algorithm == "sacfd" else []
    names += ["loss_contrastive"] if method == "ferm" else []
    header, first, *_ = (tmp_path / "whole" / "metrics.csv").read_text().splitlines()
    row = dict(zip(header.split(","), map(float, first.split(",")), strict=True))
    assert all(row[name] != 0 for name in names), row
    assert whole.step == config.steps


@pytest.mark.parametrize(
    "changes",
    [
        {"augmentation": {"name": "online"}},
        {"augmentation": {"name": "auxiliary", "weight": 0.5}, "algorithm": {"averaging": 0.9}},
        {"augmentation": {"name": "auxiliary", "quarter_turns": True}, "method": {"name": "rad"}},
        {"augmentation": {"name": "buffer", "quarter_turns": True, "copies": 2}},
        {"augmentation": {"name": "none"}, "replay": {"sampling": "symmetric"}},
        {"algorithm": {"critics": 4, "updates": 3}},
        {
            "algorithm": {"name": "sacfd"},
            "method": {"name": "ferm"},
            "augmentation": {"name": "online", "quarter_turns": True},
            "replay": {"capacity": 18, "beta_steps": 20},  # the buffer wraps
        },
    ],
    ids=str,
)
def test_what_composes_with_a_method_is_resumed_exactly(tmp_path, small_config, changes):
    config = small_config(**methods(**changes))
    run(config, tmp_path / "whole")
    run(config, tmp_path / "parts", stop_after=13)
    run(config, tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_pretraining_stopped_and_resumed_is_that_never_stopped(tmp_path, small_config):
    changes = methods(method={"name": "ferm", "pretraining": 9}, algorithm={"name": "sacfd"})
    config = small_config(**changes)
    whole = run(config, tmp_path / "whole")
    folder = tmp_path / "parts"
    stopped = run(config, folder, stop_when=lambda run: run.learner.representation.steps >= 4)
    assert (stopped.step, stopped.learner.representation.steps) == (0, 4)
    assert not (folder / "pretraining.csv").exists()
    run(config, folder)
    assert_same_run(tmp_path / "whole", folder)
    assert (folder / "pretraining.csv").read_text().splitlines()[-1].startswith("9,")
    assert whole.learner.representation.steps == 9 + config.steps


def test_after_pretraining_actor_and_target_have_what_was_learned(tmp_path, small_config):
    config = small_config(**methods(method={"name": "ferm"}))
    learner = run(config, tmp_path, stop_when=lambda run: run.learner.representation.steps).learner
    assert learner.representation.steps == 1
    loss = learner.loss
    critic, target = loss.qvalue_network_params, loss.target_qvalue_network_params
    for key, value in critic.items(True, True):
        assert torch.equal(target[key], value), key
    convolutions = [p for p in learner.critic[0].parameters() if p.ndim == 4]
    tied = [p for p in learner.actor.parameters() if p.ndim == 4]
    assert len(tied) == len(convolutions) > 0
    assert all(torch.equal(a, b) for a, b in zip(tied, convolutions, strict=True))


def test_without_demonstrations_ferm_begins_at_once(tmp_path, small_config):
    changes = methods(method={"name": "ferm"}, demos={"episodes": 0})
    training = run(small_config(**changes), tmp_path)
    assert not (tmp_path / "pretraining.csv").exists()
    assert 0 < training.learner.representation.steps < training.config.steps


def test_without_demonstrations_updates_begin_with_the_hundredth_transition(
    tmp_path, small_config, monkeypatch
):
    """Copies counted, and the first action is the policy's (SPEC, section 7)."""
    from equirl.training.learner import Learner

    seen = []
    update = Learner.update

    def noted(learner, batch):
        seen.append(batch["expert"].any().item())
        return update(learner, batch)

    monkeypatch.setattr(Learner, "update", noted)
    config = small_config(demos={"episodes": 0}, replay={"start": 100})
    training = run(config, tmp_path)
    assert len(seen) == config.steps - 19  # 20 steps with 4 copies each are 100
    assert not any(seen)
    assert len(training.buffer) == config.steps


def test_more_updates_a_step(tmp_path, small_config, monkeypatch):
    from equirl.training.learner import Learner

    count = itertools.count()
    update = Learner.update
    monkeypatch.setattr(Learner, "update", lambda *given: (next(count), update(*given))[1])
    run(small_config(**methods(algorithm={"updates": 3})), tmp_path)
    assert next(count) == 3 * 24


@pytest.mark.parametrize("sampling", ["prioritized", "symmetric"])
def test_demonstrations_outlive_a_full_buffer(tmp_path, small_config, sampling):
    changes = methods(replay={"sampling": sampling, "capacity": 15}, augmentation={"name": "none"})
    config = small_config(**changes)
    training = run(config, tmp_path)
    rows = training.buffer.storage[:]
    count = int(rows["expert"].sum())
    assert 0 < count < 15 == len(rows) < config.steps
    assert rows["expert"][:count].all()


def test_the_run_updates_priorities_and_anneals_beta(tmp_path, small_config):
    changes = methods(algorithm={"name": "sacfd"}, replay={"beta": 0.2, "beta_steps": 46})
    config = small_config(**changes)
    sampler = run(config, tmp_path).buffer.sampler
    assert sampler.beta == pytest.approx(0.2 + 0.8 * 23 / 46)  # of the last update, step 23
    priorities = sampler.state_dict()["priorities"]
    assert len(priorities.unique()) > len(priorities) / 2


def test_a_run_on_a_file_of_demonstrations_is_the_run_that_collected_them(tmp_path, small_config):
    demos = {"episodes": 2}
    config = small_config(demos=demos)
    run(config, tmp_path / "whole")
    path = tmp_path / "demonstrations.hdf5"
    record_demonstrations(small_config(demos={"episodes": 3}), path)
    run(small_config(demos=demos | {"file": str(path)}), tmp_path / "read")
    states = [load_checkpoint(tmp_path / name / CHECKPOINT) for name in ("whole", "read")]
    for state in states:
        del state["clock"], state["config"]
    assert_same(*states)
