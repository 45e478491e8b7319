"""The example with Stable-Baselines3, end to end."""

import sys

import pytest
import torch

SMALL = ["--image-size", "16", "--robot", "hand", "--episodes", "1"]


@pytest.fixture
def main():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3_sac import main

    return main


@pytest.mark.parametrize("demos", [0, 1])
def test_the_agent_trains_for_as_long_as_asked(main, demos, capsys):
    untrained = main([*SMALL, "--steps", "0", "--demos", str(demos)])
    trained = main([*SMALL, "--steps", "60", "--demos", str(demos)])
    assert (untrained.num_timesteps, trained.num_timesteps) == (0, 60)
    for network in ("actor", "critic"):
        before = getattr(untrained, network).state_dict()
        after = getattr(trained, network).state_dict()
        assert before.keys() == after.keys() and any("image" in name for name in after)
        assert not any(torch.equal(before[name], after[name]) for name in after), network
        assert all(each.isfinite().all() for each in after.values())
    assert trained.replay_buffer.size() == 60 + demos * 7
    out = capsys.readouterr().out
    assert "60 steps of training" in out and "of 1 episodes succeed" in out


# By image it means one of bytes; the depth image goes through the example's own convolutions.
@pytest.mark.filterwarnings("ignore:It seems that your observation:UserWarning")
@pytest.mark.filterwarnings("ignore:The minimal resolution for an image:UserWarning")
def test_stable_baselines3_wants_bytes_in_images_and_nothing_else():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    from equirl.envs.gymnasium import GymnasiumEnv

    with GymnasiumEnv("block_picking", image_size=16, robot="hand") as env:
        checker.check_env(env)


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "stable_baselines3_sac", raising=False)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(SystemExit, match=r"needs: pip install 'equirl\[sb3\]'"):
        import stable_baselines3_sac  # noqa: F401


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--steps", "-1"], "argument --steps: expected an integer of 0 or more, got '-1'"),
        (["--demos", "some"], "argument --demos: expected an integer of 0 or more, got 'some'"),
        (["--episodes", "0"], "argument --episodes: expected an integer of 1 or more, got '0'"),
        (["--image-size", "7"], "image_size must be an even positive integer, got 7"),
        (["--env", "equirl/BlockStacking-v0"], "invalid choice: 'equirl/BlockStacking-v0'"),
        (["--robot", "arm"], "invalid choice: 'arm'"),
    ],
)
def test_bad_arguments_are_named(main, capsys, arguments, named):
    with pytest.raises(SystemExit) as stopped:
        main([*SMALL, *arguments])
    assert stopped.value.code == 2 and named in capsys.readouterr().err
