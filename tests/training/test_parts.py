"""Seeds, evaluation, metrics and folders of runs."""

import itertools
import threading

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from equirl.collectors import DemonstrationError, OnlineCollector
from equirl.envs import make_expert
from equirl.modules import make_actor, make_cnn_actor, shared_filters
from equirl.modules.native.spectral import SpectralBasis
from equirl.modules.steerable import _Steerable
from equirl.training import (
    CheckpointError,
    FolderError,
    Purpose,
    TrainingRun,
    evaluate,
    scene_seed,
    train,
)
from equirl.training.evaluation import play
from equirl.training.folder import claim_folder, stop_on_interrupt
from equirl.training.metrics import MetricsLog


def test_seeds_of_different_purposes_never_meet():
    seeds = [
        scene_seed(run, purpose, index)
        for run, purpose, index in itertools.product(range(4), Purpose, range(500))
    ]
    assert len(set(seeds)) == len(seeds)
    assert len({seed >> 56 for seed in seeds}) == len(Purpose)  # disjoint by construction
    assert max(seeds) < 2**60 and scene_seed(1, Purpose.TEST, 5) == scene_seed(1, Purpose.TEST, 5)


def test_evaluation_of_the_expert_and_of_idling(env):
    seeds = [scene_seed(0, Purpose.TEST, index) for index in range(6)]
    outcome = evaluate(env, make_expert(env), seeds, discount=0.9)
    assert outcome.success_rate == 1 and outcome.interval[0] > 0.5
    for episode in outcome.episodes:
        assert episode.discounted_return == pytest.approx(0.9 ** (episode.length - 1))
    idle = TensorDictModule(lambda depth: torch.zeros(5), ["depth"], ["action"])
    outcome = evaluate(env, idle, seeds[:2])
    assert outcome.successes == 0 and {e.length for e in outcome.episodes} == {10}
    assert "0 of 2 episodes succeed" in str(outcome)


@pytest.mark.parametrize(
    "policy",
    [
        lambda: make_actor("C4", hidden=8, image_size=16),
        lambda: make_actor("C4", hidden=8, image_size=16, mode="paper"),
        lambda: make_cnn_actor(hidden=8, image_size=16),
    ],
)
def test_evaluation_is_deterministic_and_draws_no_random_number(env, policy):
    actor = policy()
    before = torch.get_rng_state()
    outcomes = [evaluate(env, actor, [1, 2]) for _ in range(2)]
    assert torch.equal(before, torch.get_rng_state())
    assert outcomes[0] == outcomes[1]


def test_observations_go_to_the_policys_device_and_actions_come_back(env):
    """Stands in for a GPU: the policy must see tensors of the device it is said to live on."""
    seen = []

    def policy(observation):
        seen.append(observation["depth"].device.type)
        return TensorDict({"action": torch.zeros(5)})

    play(env, policy, seed=1, device="meta")
    collector = OnlineCollector(env, policy, lambda i: i, device="meta")
    collector.act()
    assert set(seen) == {"meta"}


def test_collector_rebuilds_its_open_episode(env):
    def policy():
        generator = torch.Generator().manual_seed(0)
        act = lambda depth: 2 * torch.rand(5, generator=generator) - 1  # noqa: E731
        return TensorDictModule(act, ["depth"], ["action"])

    straight, broken = (OnlineCollector(env, policy(), lambda i: 100 + i) for _ in range(2))
    for _ in range(15):  # into the second episode
        expected, _ = straight.step(straight.act())
    for _ in range(14):
        broken.step(broken.act())
    rebuilt = OnlineCollector(env, broken.policy, lambda i: 100 + i)
    rebuilt.load_state_dict(broken.state_dict())
    assert rebuilt.episode == 1
    transition, _ = rebuilt.step(rebuilt.act())
    assert (transition == expected).all()


def test_metrics_rewind_drops_later_rows(tmp_path, small_config):
    log = MetricsLog(tmp_path, small_config())
    for step in (5, 10, 15):
        log.write("metrics", {"step": step, "value": step / 2})
    log.rewind(10)
    log.write("metrics", {"step": 15, "value": 9})
    text = (tmp_path / "metrics.csv").read_text().split()
    assert text == ["step,value", "5,2.5", "10,5.0", "15,9"]


def test_a_folder_serves_one_run_at_a_time(tmp_path):
    refused = pytest.raises(FolderError, match="another run is writing")
    with claim_folder(tmp_path), refused, claim_folder(tmp_path):
        pass
    with claim_folder(tmp_path):
        pass


def test_an_unwritable_folder_is_named(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(FolderError, match=str(blocked)), claim_folder(blocked / "run"):
        pass


def test_a_full_disk_ends_in_a_sentence(tmp_path):
    with pytest.raises(FolderError, match="No space left"), claim_folder(tmp_path):
        raise OSError(28, "No space left on device")


def test_a_folder_of_something_else_is_left_alone(tmp_path, small_config):
    (tmp_path / "metrics.csv").write_text("mine")
    with pytest.raises(FolderError, match="not the folder of a run"):
        train(small_config(), tmp_path)
    assert (tmp_path / "metrics.csv").read_text() == "mine"


def test_a_second_run_leaves_the_firsts_configuration_alone(tmp_path, small_config):
    train(small_config(steps=2), tmp_path)
    before = (tmp_path / "config.yaml").read_text()
    with claim_folder(tmp_path), pytest.raises(FolderError, match="another run"):
        train(small_config(steps=3), tmp_path)
    assert (tmp_path / "config.yaml").read_text() == before


def test_signals_are_asked_for_in_the_main_thread_only():
    answers = []

    def inside():
        with stop_on_interrupt() as asked:
            answers.append(asked())

    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert answers == [False]


def test_a_run_without_updates_says_so(tmp_path, small_config):
    config = small_config(steps=10, demos={"episodes": 0}, replay={"start": 90})
    train(config, tmp_path)
    assert "No update was made" in (tmp_path / "report.md").read_text()


def test_an_expert_that_cannot_succeed_is_named(tmp_path, small_config):
    with pytest.raises(DemonstrationError, match="failed 20 episodes in a row"):
        train(small_config(env={"max_steps": 3}), tmp_path)


def test_results_of_an_earlier_end_go_when_the_run_is_prolonged(tmp_path, small_config):
    train(small_config(steps=2), tmp_path)
    assert (tmp_path / "report.md").exists()
    with pytest.raises(CheckpointError, match="at step 2, beyond steps=1"):
        train(small_config(steps=1), tmp_path)
    assert "steps: 2" in (tmp_path / "config.yaml").read_text()  # and not what was refused
    train(small_config(steps=4), tmp_path)
    assert "after 4 environment steps" in (tmp_path / "report.md").read_text()


def test_filters_are_expanded_once_a_step(tmp_path, small_config, monkeypatch):
    run = TrainingRun(small_config(replay={"start": 5}), tmp_path)
    run._collect_demonstrations()
    run.step = 1
    expanded = []
    for form, name in ((_Steerable, "_expand"), (SpectralBasis, "expand")):

        def counted(self, weights, *sizes, expand=form.__dict__[name]):
            expanded.append(weights.data_ptr())
            return expand(self, weights, *sizes)

        monkeypatch.setattr(form, name, counted)
    with shared_filters():
        run._step()
    layers = sum(isinstance(m, _Steerable) for m in run.learner.loss.actor_network.modules())
    heads = sum(isinstance(m, _Steerable) for m in run.learner.loss.qvalue_network.modules())
    run.close()
    assert len(expanded) == len(set(expanded)) == layers + 2 * heads  # actor, critic, target
