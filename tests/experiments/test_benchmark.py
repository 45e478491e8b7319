"""The benchmark's tables, as a user asks for them, at the smallest size."""

import json
import subprocess
import sys
from pathlib import Path

import benchmark
import benchmark_updates
import measuring
import pytest
import torch
from benchmark_updates import PlainSAC
from torchrl.modules import TanhNormal

from equirl.envs.tasks import TASKS

SMALLEST = (
    "--hidden 8 --image 16 --batch 8 --repeats 1 --threads 1 --steps 4 --camera 8 --workers 2 "
    "--groups D4"
).split()
ROOT = Path(__file__).parents[2]


@pytest.fixture
def tables(monkeypatch, capfd):
    """Runs the benchmark and returns the rows of each table, by name."""

    def run(*names, extra=()):
        monkeypatch.setattr(sys, "argv", ["benchmark.py", "--only", *names, *SMALLEST, *extra])
        benchmark.main()
        out = capfd.readouterr().out
        return {name: rows(out.partition(f"## {name}\n")[2].partition("##")[0]) for name in names}

    return run


def rows(text):
    """Returns the cells of each row below the header, of one table after the other."""
    found = []
    for table in text.split("\n\n"):
        lines = [line for line in table.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1
        found += [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return found


def test_tables_of_the_environments(tables):
    printed = tables("environment", "profile", "scaling")
    for name in ("environment", "profile"):
        assert [row[:2] for row in printed[name]] == [
            [task, robot] for task in TASKS for robot in ("panda", "hand")
        ]
    for row in printed["environment"]:
        speed, _, earlier, ratio, without_camera, alone, times = (
            float(cell.split()[0]) for cell in row[2:9]
        )
        assert ratio > without_camera > 0
        # Of one round; what is above is rounded.
        assert speed / earlier == pytest.approx(ratio, rel=0.05)
        assert alone / speed == pytest.approx(times, rel=0.05)
    for row in printed["profile"]:
        simulation_steps, _, *shares, _ = map(float, row[2:])
        assert 10 < simulation_steps < 60
        assert sum(shares) == pytest.approx(100, abs=4)  # each is rounded
    expected = [(task, kind) for task in TASKS for kind in ("1 in process", "2 workers")]
    scaling, growth = printed["scaling"][: len(expected)], printed["scaling"][len(expected) :]
    assert [tuple(row[:2]) for row in scaling] == expected
    for row in scaling:
        assert row[5] == "-" if row[1] == "1 in process" else float(row[5]) > 1
    assert [row[0] for row in growth] == list(TASKS)


def test_tables_of_replay_and_networks(tables):
    printed = tables("replay", "build", "update", "acting")
    names = ["uniform, no copies", "uniform", "prioritized", "symmetric"]
    assert [row[0] for row in printed["replay"]] == 3 * names
    for row in printed["replay"]:
        ours, plain, ratio = (float(cell.split()[0]) for cell in row[1:4])
        assert ours / plain == pytest.approx(ratio, rel=0.06)  # one round; rounded
    sizes = printed["replay"][-4:]
    assert all(float(row[3]) < 0.6 for row in sizes)  # 16-bit depths, no copy stored
    expected = [["equivariant", "D4"], *([name, "-"] for name in ("cnn", "drq", "rad", "ferm"))]
    for name in ("build", "update"):
        assert [row[:2] for row in printed[name]] == expected
    for row in printed["update"]:
        parts = [float(cell) for cell in row[3:11] if cell != "-"]
        whole, plain, ratio = (float(cell.split()[0]) for cell in row[11:])
        assert len(parts) == (8 if row[0] == "ferm" else 7)
        assert sum(parts[4:]) == pytest.approx(whole, rel=0.02)
        assert whole / plain == pytest.approx(ratio, rel=0.02)
    assert float(printed["acting"][0][1]) > 0


def test_building_is_timed_as_often_as_asked(tables, monkeypatch):
    """A method and the plain one in each round, after one that is not counted."""
    built = []
    make = benchmark_updates.make_networks
    monkeypatch.setattr(
        benchmark_updates, "make_networks", lambda config: built.append(config) or make(config)
    )
    tables("build", extra=["--methods", "drq", "--repeats", "5"])
    names = [config.method.name for config in built]
    assert names == ["drq", *["drq", "cnn"] * 6]


@pytest.mark.slow
def test_memory_of_methods(tables):
    printed = tables("memory", extra=["--methods", "cnn"])["memory"]
    (plain, cnn, replay) = printed
    assert plain[:3] == ["plain", "-", "8"] and cnn[:3] == ["cnn", "-", "8"]
    assert float(plain[3]) > 100 and float(cnn[5]) > 0
    assert replay[0].endswith("GB")


@pytest.mark.slow
def test_every_table_beside_escnn(tables):
    printed = tables("layers", "kernels", "peak", "threads")
    for name, table in printed.items():
        assert table or name == "threads"  # where there are no native kernels
    assert ["8", "escnn, textbook"] in [row[:2] for row in printed["kernels"]]


def test_quick_benchmark_writes_its_tables_as_json(tmp_path):
    """As continuous integration calls it."""
    file = tmp_path / "quick.json"
    command = [sys.executable, "experiments/benchmark.py", "--quick", "--json", str(file)]
    few = ["--only", "replay", "update", "--methods", "cnn"]
    options = {"cwd": ROOT, "capture_output": True, "text": True}
    done = subprocess.run([*command, *few], **options)
    assert done.returncode == 0, done.stderr
    assert f"`python experiments/benchmark.py --quick --json {file}" in done.stdout
    written = json.loads(file.read_text())
    assert written["machine"]["threads"] == 1
    assert written["machine"]["versions"]["torch"] == torch.__version__.partition("+")[0]
    assert list(written["tables"]) == ["replay", "update"]
    (table,) = written["tables"]["update"]
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    assert row["method"] == "cnn" and row["hidden"] == 8 and row["contrastive ms"] == "-"
    low, middle, high = (row["ratio"][key] for key in ("lowest", "median", "highest"))
    assert low <= middle <= high
    wrong = subprocess.run([*command[:3], "--json", str(file / "x.json")], **options)
    assert wrong.returncode == 2 and f"there is no folder {file}" in wrong.stderr


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("1,113,118", 1113118),
        ("0.738", 0.738),
        ("-", "-"),
        ("2 workers", "2 workers"),
        ("81%", 81),
        ("1.31 GB", 1.31),
        ("1.2 (0.9 to 1e+03)", {"median": 1.2, "lowest": 0.9, "highest": 1000.0}),
        ("95 % below", "95 % below"),
        ("D4", "D4"),
    ],
)
def test_cells_become_numbers(cell, value):
    assert measuring._value(cell) == value


def test_plain_update_is_soft_actor_critic_on_a_plain_network():
    """Its first losses, by hand."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    plain = PlainSAC(8, 16)

    def uniform(*shape):
        return torch.rand(4, *shape, generator=generator)

    state = {"depth": 0.3 * uniform(1, 16, 16), "holding": uniform(1).round()}
    following = {"depth": 0.3 * uniform(1, 16, 16), "holding": uniform(1).round()}
    batch = {
        **state,
        "action": 2 * uniform(5) - 1,
        ("next", "reward"): uniform(1),
        ("next", "terminated"): torch.tensor([[True], [False], [False], [True]]),
        "next": following,
    }
    following["reward"], following["terminated"] = batch["next", "reward"], uniform(1) < 0.5
    batch["next", "terminated"] = following["terminated"]
    torch.manual_seed(1)
    with torch.no_grad():
        distribution = TanhNormal(*plain.policy(*list(following.values())[:2]))
        action = distribution.rsample()
        value = plain.target(*list(following.values())[:2], action).amin(-1)
        value = value - 0.01 * distribution.log_prob(action)
        live = 1 - following["terminated"].squeeze(-1).float()
        target = following["reward"].squeeze(-1) + 0.99 * live * value
        q = plain.critic(*state.values(), batch["action"])
        expected = sum((q[:, head] - target).square().mean() for head in (0, 1))
    torch.manual_seed(1)
    losses = plain.update(batch)
    assert losses["loss_qvalue"] == pytest.approx(expected.item(), rel=1e-5)
