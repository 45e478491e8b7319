"""The paper's experiments and other sweeps: what they train, and that nothing ends them."""

import importlib
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import sweeping
from hydra import compose, initialize_config_dir
from hydra.core.plugins import Plugins
from hydra_plugins import equirl_sweeper

from equirl.config import load_config, register
from tests.commands import ROOT
from tests.smoke.sweeps import TINY, make_run

TASKS = {"block_picking", "clutter_grasping", "block_pushing", "block_in_bowl"}
EXPERIMENTS = {
    "groups": ("group", ["C4", "C8", "D4", "D8", "SO2", "O2"]),
    "fig12": ("augmentation.copies", [0, 2, 4, 8, 16]),
    "fig13": ("demos.episodes", [0, 10, 20, 40]),
    "fig14": ("algorithm.name", ["sac", "sacfd"]),
    "fig15": ("method.name", ["equivariant", "cnn", "drq", "rad", "ferm"]),
    "fig16": ("method.name", ["equivariant", "cnn", "drq", "rad", "ferm"]),
}


@pytest.fixture
def planned(here, monkeypatch, tmp_path):
    """The runs of a command line, without the hours that a dry run would measure."""
    monkeypatch.chdir(tmp_path)
    plans = []

    def call(*arguments: str) -> list:
        monkeypatch.setattr("planning.print_plan", lambda runs, **_: plans.append(runs))
        code, _, err = here("train.py", *arguments, "dry_run=true")
        assert code == 0, err
        assert not list(tmp_path.iterdir())  # nothing was written
        return plans.pop()

    return call


def value(config, key: str):
    for part in key.split("."):
        config = getattr(config, part)
    return config


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_train_what_the_paper_did(planned, name):
    """Four runs of each variant on each task; here the tasks and seeds are looked at one by one."""
    key, variants = EXPERIMENTS[name]
    runs = planned(f"+experiment={name}", "seed=3", "env=block_in_bowl")
    assert [value(run.config, key) for run in runs] == variants
    for run in runs:
        config = run.config
        assert (config.mode, config.env.image_size, config.steps) == ("paper", 128, 10_000)
        assert (config.seed, config.env.task) == (3, "block_in_bowl")
        assert config.algorithm.name == "sacfd" if name == "fig16" else True
        assert config.algorithm.name == "sac" if name not in ("fig14", "fig16") else True
        assert config.method.name == "equivariant" or name in ("fig15", "fig16")
        assert config.group == "D4" or name == "groups"
        assert config.copies == 4 or name == "fig12"
        assert config.demos.episodes == 20 or name == "fig13"
        assert run.folder.parent.parts[-3:] == ("experiments", name, "paper")
    assert len({run.folder for run in runs}) == len(variants)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_have_four_runs_on_each_task(name):
    register()
    root = Path(__file__).parents[2] / "conf"
    with initialize_config_dir(str(root), version_base="1.3"):
        config = compose("config", [f"+experiment={name}"], return_hydra_config=True)
    params = config.hydra.sweeper.params
    assert params.seed == "0,1,2,3" and set(params.env.split(",")) == TASKS
    assert config.hydra.mode.name == "MULTIRUN" and len(params) == 3


def test_what_stands_on_the_command_line_counts(planned):
    """It beats the experiment, which beats the preset, which beats the defaults."""
    small = ["seed=0", "env=block_picking"]
    runs = planned("+experiment=fig13", "preset=laptop", "demos.episodes=5,6", "group=c8", *small)
    assert [run.config.demos.episodes for run in runs] == [5, 6]
    assert {run.config.group for run in runs} == {"C8"}
    assert {run.config.algorithm.discount for run in runs} == {0.95}  # the preset's
    assert runs[0].folder.parent.parts[-2:] == ("fig13", "laptop")
    (run,) = planned("+experiment=fig14", "preset=smoke", "algorithm=sacfd", *small)
    assert (run.config.demos.episodes, run.config.algorithm.name) == (20, "sacfd")
    assert run.config.env.image_size == 16


def test_a_cut_sweep_has_the_folders_of_the_whole(planned):
    whole = planned("+experiment=fig14", "preset=smoke", "env=block_picking,block_pushing")
    cut = planned("+experiment=fig14", "seed=2", "preset=smoke", "env=block_pushing", "threads=1")
    assert len(whole) == 16 and len({run.folder for run in whole}) == 16
    assert {run.folder for run in cut} < {run.folder for run in whole}


def test_however_a_run_is_spelt_it_has_one_folder(planned):
    """The folder is named after the value, so that the finished run is found again."""
    small = ["--multirun", "preset=smoke", "env=block_pushing", "seed=0,1", "hydra.sweep.dir=x"]
    first = ["group=C4", "algorithm.tau=0.02", "augmentation.quarter_turns=false"]
    again = ["group=c4", "algorithm.tau=2e-2", "augmentation.quarter_turns=False"]
    option = "env.options.lift_height=0.1"
    small[2] = "env=clutter_grasping"
    runs = [planned(*small, *keys) for keys in ([*first, option], [*again, f"{option}0"])]
    assert [run.folder for run in runs[0]] == [run.folder for run in runs[1]]
    assert "group-C4" in runs[0][0].folder.name and "seed-0" in runs[0][0].folder.name


def test_no_two_runs_share_a_folder(tmp_path):
    """Though their names are the same, too long, or of characters that no folder has."""
    given = [
        ["x=1_y-2", "y=3"],
        ["x=1", "y=2_y-3"],
        ["demos.file=/a/b"],
        ["demos.file=/a-b"],
        ["text=" + "a" * 300],
        ["text=" + "a" * 299 + "b"],
    ]
    runs = [make_run(overrides, seed=seed) for seed, overrides in enumerate(given)]
    sweeping.give_folders(runs, tmp_path)
    folders = {run.folder for run in runs}
    assert len(folders) == 6 and {folder.parent for folder in folders} == {tmp_path}
    assert all(len(folder.name) <= 200 for folder in folders)


@pytest.mark.parametrize("second", [{"group": "d4"}, {"threads": 1}, {"logging": {"wandb": True}}])
def test_no_two_runs_are_one(second, tmp_path):
    """Neither the spelling of a group nor the number of threads makes another seed stream."""
    runs = [make_run(["a=1"]), make_run(["a=2"], **second)]
    with pytest.raises(ValueError, match="no run was begun, since two are the same"):
        sweeping.give_folders(runs, tmp_path)


@pytest.mark.parametrize(
    ("sweep", "named"),
    [
        (["group=c4,c8,so3"], "group=so3: group=so3: unknown symmetry group 'so3'"),
        (["method=cnn,resnet"], "method=resnet: expected one of cnn"),
        (["seed=0,1", "stepz=3"], "stepz: there is no such key; did you mean steps?"),
        (["replay.capacity=100,3"], "replay.capacity=3: expected 5 or more"),
        (["seed=0,1", "device=cuda:7"], "device=cuda:7"),
        (["seed=0,1", "threads=100000"], "threads=100000: this machine has"),
        (["seed=0,1,0"], "two are the same"),
        (["seed=0,1", "output=x"], "a multirun makes a folder for each"),
        (["seed=range(0,0)"], "the sweep has no runs: preset=smoke seed=range(0,0)"),
        (["+experiment=fig15,fig16"], "experiment=fig15,fig16: one experiment a command"),
        (["+experiment=[fig15,fig16]"], "experiment=[fig15,fig16]: one experiment a command"),
    ],
)
def test_a_bad_combination_stops_a_sweep_before_it_begins(here, sweep, named, tmp_path):
    given = [f"hydra.sweep.dir={tmp_path / 'sweep'}", *sweep]
    code, out, err = here("train.py", "--multirun", "preset=smoke", *given)
    assert code == 1 and named in err and "Traceback" not in err
    assert "run folder" not in out and not (tmp_path / "sweep").exists()


def test_a_mistake_of_ours_keeps_its_traceback(here, tmp_path, monkeypatch):
    """Nobody could mend their command line by it."""

    def fail(*_):
        raise ZeroDivisionError("planted")

    Plugins.instance()  # loads the sweeper once more when it is first asked
    monkeypatch.setattr(equirl_sweeper, "to_config", fail)
    with pytest.raises(ZeroDivisionError):
        here("train.py", "--multirun", "preset=smoke", f"hydra.sweep.dir={tmp_path / 'sweep'}")


def test_other_machines_are_not_measured_by_this_one(planned):
    """Where a cluster of Ray's trains, or SLURM's."""
    asked = ["--multirun", "preset=smoke", "threads=100000", "device=cuda:7"]
    for cluster in (
        ["hydra/launcher=ray", "hydra.launcher.address=auto"],
        ["hydra/launcher=slurm"],
    ):
        (run,) = planned(*asked, *cluster, "seed=0")
        assert run.config.threads == 100_000


def test_a_typing_error_beside_an_experiment_is_the_one_told(here):
    code, _, err = here("train.py", "+experiment=fig12", "preset=lptop", "seed=0,1")
    assert code == 1 and "preset=lptop: expected one of laptop, paper, smoke" in err
    code, _, err = here("train.py", "+experiment=fig11")
    assert code == 1 and "experiment=fig11: expected one of fig12" in err


def test_a_failed_run_is_told_and_tried_again(here, tmp_path, monkeypatch):
    """Whatever it failed of; the others are trained, and skipped when it is tried again."""
    sweep = ["--multirun", *TINY, "seed=0,1,2", f"hydra.sweep.dir={tmp_path}"]
    import equirl.training

    honest = equirl.training.train

    def failing(config, folder, should_stop):
        if config.seed == 1:
            raise ZeroDivisionError("planted")
        return honest(config, folder, should_stop)

    monkeypatch.setattr(equirl.training, "train", failing)
    code, out, err = here("train.py", *sweep)
    assert code == 1 and "3 runs: 2 finished, 1 failed" in out
    assert "1 run failed:\nseed=1: ZeroDivisionError: planted" in err
    (failed,) = tmp_path.glob("*/failed.txt")
    assert "seed-1" in failed.parent.name and "Traceback" in failed.read_text()
    for path in (ROOT, tmp_path, Path.home()):  # where it stood is nobody's business
        assert f"{path}/" not in failed.read_text()

    monkeypatch.setattr(equirl.training, "train", honest)
    code, out, err = here("train.py", *sweep, "dry_run=true")
    assert code == 0 and "| seed=0 | finished | 0 |" in out
    assert "| seed=1 | failed, at step 0 of 12: ZeroDivisionError: planted |" in out
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*seed-[02]*/[!.]*")}
    code, out, err = here("train.py", *sweep)
    assert code == 0 and out.count("run folder") == 1 and "3 runs: 3 finished" in out, err
    assert not failed.exists()
    assert before == {path: path.stat().st_mtime_ns for path in before}
    code, out, _ = here("train.py", *sweep, "threads=2")  # the same runs
    assert code == 0 and "run folder" not in out


#: Trains; the run of seed 1 is killed when it has a checkpoint, however fast it or the test is.
KILLED_AT_ITS_CHECKPOINT = """
import os
import equirl.training, train
honest = equirl.training.train
def killed(config, folder, should_stop):
    def kill():
        if config.seed == 1 and (folder / "checkpoint.pt").exists():
            os.kill(os.getpid(), 9)
        return False
    return honest(config, folder, kill)
equirl.training.train = killed
train.main()
"""


def test_a_killed_sweep_goes_on(here, tmp_path, monkeypatch):
    """The finished run is left alone, the open one resumed, the last one begun."""
    monkeypatch.chdir(tmp_path)
    sweep = ["+experiment=fig14", *TINY, "env=block_picking", "algorithm=sac"]
    sweep += ["checkpoint_every=5", "seed=0,1,2"]
    command = [sys.executable, "-c", KILLED_AT_ITS_CHECKPOINT, *sweep]
    paths = os.pathsep.join([str(ROOT / "experiments"), str(ROOT)])
    killed = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, timeout=300)
    assert killed.returncode == -signal.SIGKILL
    code, out, err = here("train.py", *sweep, "dry_run=true")
    assert "| seed=0 | finished | 0 |" in out and "seed=2 | new |" in out
    assert "| seed=1 | begun, at step " in out and "3 runs: 1 finished, 1 begun, 1 new" in out
    assert out.count("| like runs |") == 2
    code, out, err = here("train.py", *sweep)
    assert code == 0 and out.count("run folder") == 2 and "goes on after step" in err, err
    code, out, err = here("train.py", *sweep)
    assert code == 0 and "run folder" not in out and "3 runs: 3 finished" in out


def test_what_a_folder_holds_is_not_trained_over(here, tmp_path):
    """A sweep's folder keeps its runs when the same names would mean something else."""
    one = ["--multirun", *TINY, f"hydra.sweep.dir={tmp_path}"]
    assert here("train.py", *one, "seed=0")[0] == 0
    (run,) = tmp_path.glob("*seed-0*")
    config = load_config(run / "config.yaml")
    shutil.copy(run / "config.yaml", tmp_path / "kept.yaml")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("tau: 0.01", "tau: 0.5"))
    code, out, err = here("train.py", *one, "seed=0")
    assert code == 1 and "algorithm.tau is 0.5 there and 0.01 here" in err and config.seed == 0
    assert "run folder" not in out


def test_a_dry_run_of_one_run(here, tmp_path):
    code, out, _ = here("train.py", *TINY, f"output={tmp_path / 'run'}", "dry_run=true")
    assert code == 0 and "| new |" in out and "measured" in out and "left: " in out
    assert not (tmp_path / "run").exists()


def test_a_dry_run_in_the_folder_of_another_run(here, tmp_path):
    """The advice is that of its command line."""
    assert here("train.py", *TINY, f"output={tmp_path}", "steps=5")[0] == 0
    code, _, err = here(
        "train.py", *TINY, f"output={tmp_path}", "algorithm.tau=0.5", "dry_run=true"
    )
    assert code == 1 and "algorithm.tau is 0.01 there and 0.5 here; choose another output" in err


PAGE = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text()


@pytest.mark.parametrize("command", re.findall(r"python experiments/train\.py (.*)", PAGE))
def test_commands_of_the_page_are_such(planned, command):
    """Each as printed, cut to a seed and a task for speed."""
    given = command.replace("$SLURM_CPUS_PER_TASK", "1").split()
    runs = planned(
        *(text for text in given if "dry_run" not in text), "seed=0", "env=block_picking"
    )
    assert runs and all(run.config.seed == 0 for run in runs)


def test_the_script_without_submitit_asks_for_what_it_uses():
    (script,) = re.findall(r"^```\n(#SBATCH.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    asked, command = script.split("\nsrun ")
    assert "--cpus-per-task=" in asked and "--signal=TERM@" in asked
    assert command.startswith("--cpus-per-task=$SLURM_CPUS_PER_TASK python ")


def test_the_site_numbers_the_steps_on_a_cluster(monkeypatch):
    for library in ("pdoc", "markdown", "pygments"):
        pytest.importorskip(library)
    monkeypatch.syspath_prepend(ROOT / "docs")
    body = importlib.import_module("build_site").render(Path("docs/sweeps.md"))
    steps = body[body.index("120 runs on a SLURM cluster") :]
    lists = re.findall(r'<ol(?: start="(\d+)")?>\n(.*?)</ol>', steps, re.DOTALL)
    assert [(start, text.count("<li>")) for start, text in lists] == [("", 5), ("6", 2)]
