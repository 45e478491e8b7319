"""Seeds, evaluation, metrics and folders of runs."""

import itertools

import pytest
import torch
from tensordict.nn import TensorDictModule

from equirl.collectors.online import OnlineCollector
from equirl.envs import make_env, make_expert
from equirl.training import FolderError, Purpose, evaluate, scene_seed
from equirl.training.folder import claim_folder, prepare_folder
from equirl.training.metrics import MetricsLog


def test_seeds_of_different_purposes_never_meet():
    seeds = [
        scene_seed(run, purpose, index)
        for run, purpose, index in itertools.product(range(4), Purpose, range(500))
    ]
    assert len(set(seeds)) == len(seeds)
    assert len({seed >> 56 for seed in seeds}) == len(Purpose)  # disjoint by construction
    assert max(seeds) < 2**59 and scene_seed(1, Purpose.TEST, 5) == scene_seed(1, Purpose.TEST, 5)


@pytest.fixture
def env():
    env = make_env("block_picking", image_size=16, robot="hand", max_steps=10)
    yield env
    env.close()


def test_evaluation_of_the_expert_and_of_idling(env):
    seeds = [scene_seed(0, Purpose.TEST, index) for index in range(6)]
    outcome = evaluate(env, make_expert(env), seeds, discount=0.9)
    assert outcome.success_rate == 1 and outcome.interval[0] > 0.5
    for episode in outcome.episodes:
        assert episode.discounted == pytest.approx(0.9 ** (episode.length - 1))
    idle = TensorDictModule(lambda depth: torch.zeros(5), ["depth"], ["action"])
    outcome = evaluate(env, idle, seeds[:2])
    assert outcome.successes == 0 and {e.length for e in outcome.episodes} == {10}
    assert "0 of 2 episodes succeed" in str(outcome)


def test_evaluation_draws_no_random_number(env):
    torch.manual_seed(0)
    before = torch.get_rng_state()
    evaluate(env, make_expert(env), [1, 2])
    assert torch.equal(before, torch.get_rng_state())


def test_collector_rebuilds_its_open_episode(env):
    def policy():
        generator = torch.Generator().manual_seed(0)
        act = lambda depth: 2 * torch.rand(5, generator=generator) - 1  # noqa: E731
        return TensorDictModule(act, ["depth"], ["action"])

    straight, broken = (OnlineCollector(env, policy(), lambda i: 100 + i) for _ in range(2))
    for _ in range(14):  # into the second episode
        last, _ = straight.step(straight.act())
    follow = straight.act()
    for _ in range(14):
        broken.step(broken.act())
    rebuilt = OnlineCollector(env, broken.policy, lambda i: 100 + i)
    rebuilt.load_state_dict(broken.state_dict())
    assert rebuilt.episode == 1
    following = rebuilt.act()
    assert torch.equal(following["depth"], follow["depth"])
    assert torch.equal(last["next", "depth"][0], follow["depth"])
    assert torch.equal(following["action"], follow["action"])


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


def test_an_unwritable_folder_is_named(tmp_path, small_config):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(FolderError, match=str(blocked)):
        prepare_folder(blocked / "run", small_config())
