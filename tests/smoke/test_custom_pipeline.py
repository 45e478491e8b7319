"""The example and the page on pipelines of one's own: docs/custom_pipeline.md."""

import re
import subprocess
import sys

import custom_pipeline
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from tests.commands import ROOT
from tests.equivariance import assert_equivariant, grid_elements, turn_image

PAGE = (ROOT / "docs" / "custom_pipeline.md").read_text()
PIECES = re.findall(r"```py\n(.*?)```", PAGE, re.DOTALL)
SMALL = ["--steps", "40", "--episodes", "2", "--copies", "2"]


def turn_vectors(vectors: torch.Tensor, turns: int, flip: bool) -> torch.Tensor:
    """y -> -y, then quarter turns from x to y; shape (..., 2)."""
    x, y = vectors.unbind(-1)
    if flip:
        y = -y
    for _ in range(turns):
        x, y = -y, x
    return torch.stack([x, y], -1)


def test_the_environment_keeps_to_the_rules_of_both_libraries():
    spec = EnvSpec("MineField-v0", entry_point=custom_pipeline.MineField)
    check_env(gymnasium.make(spec).unwrapped)
    check_env_specs(custom_pipeline.make_env(0))


@pytest.mark.parametrize("turns, flip", grid_elements("D4"))
def test_the_declared_symmetry_is_exact(turns, flip):
    rng = np.random.default_rng(4 * flip + turns)
    envs = custom_pipeline.MineField(), custom_pipeline.MineField()
    seen = set()
    for episode in range(20):
        first, _ = envs[0].reset(seed=episode)
        state = {"places": torch.tensor(envs[0].places), "reach": envs[0].reach}
        turned = turn_vectors(state["places"], turns, flip).numpy()
        second, _ = envs[1].reset(options={**state, "places": turned})
        over, results = False, (0.0, 0.0)
        for _ in range(20):
            pixels = torch.tensor(first["pixels"]).permute(2, 0, 1)
            turned = torch.tensor(second["pixels"]).permute(2, 0, 1)
            assert torch.equal(turn_image(pixels, turns, flip), turned)
            assert first["reach"] == second["reach"]
            if over:
                break
            hop = torch.tensor(rng.uniform(-1, 1, 2))  # also off the disc
            first, *results, _, _ = envs[0].step(hop.numpy())
            second, *others, _, _ = envs[1].step(turn_vectors(hop, turns, flip).numpy())
            assert results == others
            over = results[1]
        seen.add(tuple(results))
    assert (1.0, True) in seen and (0.0, True) in seen  # targets and mines


def test_hops_are_as_long_as_said_and_no_longer():
    env = custom_pipeline.MineField()
    for hop, moved in (([0.5, 0.0], [0.1, 0.0]), ([3.0, -4.0], [0.12, -0.16])):
        env.reset(options={"places": np.full((4, 2), 0.5), "reach": 0.2})
        env.step(np.array(hop))
        np.testing.assert_allclose(env.places, np.full((4, 2), 0.5) - moved)


@pytest.mark.parametrize("group", ["D4", "C4"])
def test_distribution_and_values_are_equivariant(group):
    torch.manual_seed(0)
    actor, critics = custom_pipeline.symmetric_networks(group)
    for module in (actor, *critics):
        module.double()
    inputs = {
        "pixels": torch.rand(3, 2, 16, 16, dtype=torch.float64),
        "reach": torch.rand(3, 1, dtype=torch.float64),
        "action": torch.rand(3, 2, dtype=torch.float64) - 0.5,
    }

    def networks(**inputs):
        data = TensorDict(inputs, [3])
        policy = actor.get_dist(data)
        values = [critic(data.clone())["state_action_value"] for critic in critics]
        return {
            "loc": policy.loc,
            "scale": policy.scale,
            "greedy": policy.deterministic_sample,
            "log_prob": policy.log_prob(inputs["action"]),
            "values": torch.cat(values, -1),
        }

    turns = {name: turn_vectors for name in ("action", "loc", "greedy")}
    with torch.no_grad():
        assert_equivariant(networks, group, inputs, {"pixels": turn_image, **turns}, case=group)
        moved = (
            networks(**inputs)["greedy"]
            - networks(**inputs | {"reach": inputs["reach"] + 1})["greedy"]
        )
    assert moved.abs().min() > 1e-9  # every input counts


@pytest.mark.parametrize("kind", [["--group", "c4"], ["--plain"]])
def test_the_example_trains(kind, capsys):
    actor = custom_pipeline.main([*SMALL, *kind])
    torch.manual_seed(0)
    make = custom_pipeline.plain_networks, lambda: custom_pipeline.symmetric_networks("C4")
    untrained = make[kind != ["--plain"]]()[0].state_dict()
    trained = actor.state_dict()
    assert trained.keys() == untrained.keys() and all(w.isfinite().all() for w in trained.values())
    assert not any(torch.equal(trained[name], untrained[name]) for name in trained)
    out = capsys.readouterr().out
    assert "of 2 episodes before" in out and "40 steps and updates in" in out
    error = float(re.search(r"actions differ by (\S+)", out)[1])
    assert error > 1e-4 if kind == ["--plain"] else error < 1e-4


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--group", "Q8"], "unknown symmetry group 'Q8'"),
        (["--copies", "-1"], "argument --copies: expected an integer of 0 or more, got '-1'"),
        (["--steps", "0"], "argument --steps: expected an integer of 1 or more, got '0'"),
    ],
)
def test_bad_arguments_are_named(arguments, named, capsys):
    with pytest.raises(SystemExit) as stopped:
        custom_pipeline.main(arguments)
    assert stopped.value.code == 2 and named in capsys.readouterr().err


def test_the_pieces_of_the_page_are_a_script():
    names: dict = {}
    torch.manual_seed(0)
    exec("\n".join(PIECES), names)
    weights = [TensorDict.from_module(critic) for critic in names["critics"]]  # as they were made
    trained = names["loss"].qvalue_network_params
    for key, before in torch.stack(weights).items(True, True):
        after = trained[key]
        assert all(not torch.equal(*pair) for pair in zip(before, after, strict=True)), key


def test_it_needs_no_simulator_and_no_hydra():
    """In a process of its own, as its users start it."""
    code = (
        "import sys, custom_pipeline; custom_pipeline.main(sys.argv[1:]); "
        "assert not {'pybullet', 'hydra', 'omegaconf', 'equirl.envs'} & set(sys.modules)"
    )
    command = [sys.executable, "-c", code, *SMALL]
    done = subprocess.run(
        command, cwd=ROOT / "experiments", capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and "of 2 episodes after training" in done.stdout, done.stderr
    assert "Warning" not in done.stderr


def test_axes_of_common_pictures():
    """What the page says about pictures with x to the right."""
    canvas = np.zeros((4, 4))  # rows are read downwards
    x, y = 3, 1  # from the left, from the lower edge
    canvas[3 - y, x] = 1
    assert np.rot90(canvas, -1)[x, y] == 1
    assert canvas.T[x, 3 - y] == 1
