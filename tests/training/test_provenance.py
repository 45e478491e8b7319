"""The record of a run: what it says, what it keeps to itself, and what becomes of it on resume."""

import getpass
import json
import logging
import os
import platform
import subprocess
import sys
import types
from pathlib import Path

import pytest
import torch

import equirl
from equirl.training import TrainingRun, train
from equirl.training.privacy import without_paths
from equirl.training.provenance import read_record, record_session, summarize_record
from tests.training.runs import assert_same_run


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Makes equirl's code that of a repository of ours; returns its folder."""
    root = tmp_path / "code"
    (root / "equirl").mkdir(parents=True)
    (root / "equirl/__init__.py").write_text("one\n")
    git(root, "init", "-q")
    git(root, "add", ".")
    commit(root)
    monkeypatch.setattr(equirl, "__file__", str(root / "equirl/__init__.py"))
    return root


def git(root: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    command = ["git", "-C", str(root), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def commit(root: Path) -> None:
    git(root, "commit", "-q", "-a", "-m", "work")


def record(config, folder, outcome="finished", step=7):
    """Adds a session; returns the whole record."""
    folder.mkdir(exist_ok=True)
    with record_session(config, folder, lambda: step) as session:
        session.end(outcome)
    return read_record(folder)


def test_a_finished_run_tells_how_it_was_made(tmp_path, small_config, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["experiments/train.py", "group=c4"])
    train(small_config(seed=3), tmp_path / "run")
    made = json.loads((tmp_path / "run/run.json").read_text())
    (session,) = made["sessions"]
    assert session["outcome"] == "finished" and session["last_step"] == 24
    assert session["started"] <= session["ended"] and made["minutes"] == session["minutes"] > 0
    assert session["versions"]["torch"] == torch.__version__.partition("+")[0]
    assert session["versions"]["python"] == platform.python_version()
    assert session["machine"]["cores"] == os.cpu_count()
    assert session["computing"]["threads"] == 1
    assert session["computing"]["backend"] in ("native", "dense")  # what "auto" came to
    assert session["command"][1:] == ["experiments/train.py", "group=c4"]
    assert made["seeds"]["run"] == 3 and len(set(made["seeds"]["streams"].values())) == 8
    report = (tmp_path / "run/report.md").read_text()
    assert "## How it was made" in report and f"torch {session['versions']['torch']}" in report
    assert "in 1 session, from" in report and "| `run.json` |" in report


def test_sessions_are_appended_and_change_nothing_in_the_run(tmp_path, small_config, monkeypatch):
    """Stopped, then failed, then finished: bit for bit the run that never was."""
    config, folder = small_config(), tmp_path / "parts"
    train(config, tmp_path / "whole")
    with monkeypatch.context() as patch:
        module = sys.modules[train.__module__]
        patch.setattr(module, "stop_on_interrupt", stops_after(9))  # a demonstration, eight steps
        assert train(config, folder) is None
    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "_validate", lambda run: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            train(config, folder)
    train(config, folder)
    train(config, folder)  # is finished already
    assert_same_run(tmp_path / "whole", folder)
    sessions = read_record(folder)["sessions"]
    assert [(each["first_step"], each["outcome"]) for each in sessions] == [
        (0, "stopped"),
        (9, "failed: ZeroDivisionError: division by zero"),
        (9, "finished"),
    ]
    total = sum(each["minutes"] for each in sessions)
    assert read_record(folder)["minutes"] == pytest.approx(total)


def stops_after(questions: int):
    """What stands for Ctrl-C: the answer to whether to stop, yes at so many-th asking."""
    from contextlib import contextmanager

    @contextmanager
    def stop_on_interrupt():
        asked = iter(range(questions))
        yield lambda: next(asked, None) is None

    return stop_on_interrupt


def test_a_killed_session_ends_where_it_was_last_seen(tmp_path, small_config):
    record(small_config(), tmp_path)
    path = tmp_path / "run.json"
    killed = json.loads(path.read_text())
    killed["sessions"][0] |= {"outcome": None, "ended": None, "minutes": 0.0}
    path.write_text(json.dumps(killed))
    seen = path.stat().st_mtime + 120
    (tmp_path / "metrics.csv").write_text("step\n")
    os.utime(tmp_path / "metrics.csv", (seen, seen))
    first, last = record(small_config(), tmp_path)["sessions"]
    assert first["outcome"] == "killed" and first["minutes"] == pytest.approx(2, abs=0.1)
    assert last["outcome"] == "finished"


def test_changed_versions_and_code_are_warned_about(
    tmp_path, small_config, repository, monkeypatch, caplog
):
    config, folder = small_config(), tmp_path / "run"
    record(config, folder)
    record(config, folder)
    assert not caplog.records
    before = git(repository, "rev-parse", "HEAD")
    (repository / "equirl/__init__.py").write_text("two\n")
    commit(repository)
    after = git(repository, "rev-parse", "HEAD")
    monkeypatch.setattr(equirl, "__version__", "99.0")
    with caplog.at_level(logging.WARNING, logger="equirl"):
        made = record(config, folder, step=12)
    (message,) = [entry.getMessage() for entry in caplog.records]
    assert message.startswith("this run goes on with equirl 99.0 (was ")
    assert f"commit {after[:12]} (was commit {before[:12]})" in message
    assert "Session 3 went on from step 12 with equirl 99.0" in "\n".join(summarize_record(made))


def test_changes_to_the_code_are_kept_with_the_run(tmp_path, small_config, repository):
    config, folder = small_config(), tmp_path / "run"
    clean = record(config, folder)["sessions"][0]["code"]
    assert clean["commit"] == git(repository, "rev-parse", "HEAD") and clean["of"] == "equirl"
    assert not clean["dirty"] and not list(folder.glob("*.patch"))
    source = repository / "equirl/__init__.py"
    for text, name in (
        ("two\n", "changes.patch"),
        ("two\n", "changes.patch"),
        ("three\n", "changes_4.patch"),
        ("two\n", "changes.patch"),
    ):
        source.write_text(text)
        code = record(config, folder)["sessions"][-1]["code"]
        assert code["dirty"] and code["changes"] == name
    git(repository, "checkout", "-q", ".")
    git(repository, "apply", str(folder / "changes_4.patch"))
    assert source.read_text() == "three\n"
    source.write_text("x" * 300_000)
    (repository / "task.py").write_text("")
    code = record(config, folder)["sessions"][-1]["code"]
    assert code["dirty"] and code["changes"] is None and code["untracked"] == ["task.py"]


@pytest.mark.parametrize(
    "configured",
    [
        *("diff.noprefix=true", "diff.mnemonicPrefix=true", "diff.context=0"),
        *("color.diff=always", "diff.upper.textconv=tr a-z A-Z <"),
    ],
)
def test_kept_changes_apply_whatever_git_is_told(tmp_path, small_config, repository, configured):
    """To text, to text of another encoding, and to what is no text."""
    files = {"one.py": b"# caf\xe9\none\n", "two.bin": bytes(range(256)), "three.upper": b"three\n"}
    same = 9 * b"same\n"
    (repository / ".gitattributes").write_text("*.upper diff=upper\n")
    for name, content in files.items():
        (repository / name).write_bytes(same + content + same)
    git(repository, "add", ".")
    commit(repository)
    git(repository, "config", *configured.split("=", 1))
    for name, content in files.items():
        (repository / name).write_bytes(same + content[::-1] + same)
    assert record(small_config(), tmp_path / "run")["sessions"][0]["code"]["changes"]
    git(repository, "checkout", "-q", ".")
    git(repository, "apply", str(tmp_path / "run/changes.patch"))
    for name, content in files.items():
        assert (repository / name).read_bytes() == same + content[::-1] + same, name


def test_no_room_for_a_copy_of_the_index_ends_no_run(
    tmp_path, small_config, repository, monkeypatch
):
    def full():
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("equirl.training.repository.TemporaryDirectory", full)
    (repository / "equirl/__init__.py").write_text("two\n")
    code = record(small_config(), tmp_path / "run")["sessions"][0]["code"]
    assert code["commit"] == git(repository, "rev-parse", "HEAD") and code["changes"] is None


def test_new_files_are_code_too(tmp_path, small_config, repository, caplog):
    """What is in them counts, as does how many there are."""
    config, folder = small_config(), tmp_path / "run"
    (repository / "task.py").write_text("one\n")
    record(config, folder)
    record(config, folder)
    assert not caplog.records
    (repository / "task.py").write_text("two\n")
    record(config, folder)
    assert "this run goes on with code commit" in caplog.text
    for number in range(149):
        (repository / f"täsk {number}.py").write_text("")
    new = record(config, folder)["sessions"][-1]["code"]["untracked"]
    assert len(new) == 101 and new[-1] == "and 50 more"
    assert "täsk 0.py" in new


def test_the_index_of_the_repository_is_left_alone(tmp_path, small_config, repository):
    source = repository / "equirl/__init__.py"
    os.utime(source, (1, 1))  # what `git status` would note in the index
    before = (repository / ".git/index").read_bytes()
    record(small_config(), tmp_path / "run")
    assert (repository / ".git/index").read_bytes() == before


@pytest.mark.parametrize("missing", ["git", "repository"])
def test_without_git_or_a_repository_the_rest_is_told(
    tmp_path, small_config, repository, monkeypatch, missing
):
    if missing == "git":
        monkeypatch.setenv("PATH", str(tmp_path))
    else:  # installed as a package, into an environment, and called from somewhere
        monkeypatch.setattr(equirl, "__file__", str(tmp_path / "site-packages/equirl/__init__.py"))
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    made = record(small_config(), tmp_path / "run")
    assert made["sessions"][0]["code"] is None and made["sessions"][0]["versions"]
    assert "| code | under no version control |" in summarize_record(made)


def test_an_installed_package_is_no_part_of_the_repository_around_it(
    tmp_path, small_config, repository, monkeypatch
):
    """The environment is inside the user's project: its commit is named as that."""
    package = repository / ".venv/site-packages/equirl"
    package.mkdir(parents=True)
    (repository / ".gitignore").write_text(".venv\n")
    git(repository, "add", ".gitignore")
    commit(repository)
    monkeypatch.setattr(equirl, "__file__", str(package / "__init__.py"))
    monkeypatch.chdir(repository)
    made = record(small_config(), tmp_path / "run")
    assert made["sessions"][0]["code"]["of"] == "the working folder"
    assert "of the working folder" in "\n".join(summarize_record(made))


@pytest.mark.parametrize("private", [True, False])
def test_nothing_names_a_person_a_computer_or_a_path_unless_asked(
    tmp_path, small_config, monkeypatch, private
):
    home = tmp_path / "home" / "somebody"
    (home / "project").mkdir(parents=True)
    monkeypatch.chdir(home / "project")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setattr(getpass, "getuser", lambda: "somebody")
    named = types.SimpleNamespace(argv=["/opt/x/train.py", f"output={home}/project/run"])
    extra = [f"demos.file='{home}/my data/d.hdf5'", "demos.file=/mnt/secret/d.hdf5", "a=b/c"]
    monkeypatch.setattr(sys, "argv", [*named.argv, *extra])
    config = small_config(logging={"private": private})
    with pytest.raises(OSError), record_session(config, Path("."), lambda: 0):
        raise OSError(f"no space for {home}/elsewhere/file")
    text = Path("run.json").read_text()
    (session,) = json.loads(text)["sessions"]
    secrets = [str(tmp_path), "/mnt/secret", "somebody", str(Path(sys.executable).parent)]
    for secret in secrets:
        assert (secret in text) is not private, secret
    assert (session["machine"].get("host") == platform.node()) is not private
    if private:
        names = [*platform.node().split("."), "/opt/x"]
        machine = json.dumps(session["machine"]) + json.dumps(session["command"])
        assert not [name for name in names if f'"{name}"' in machine]
        assert session["command"][1:] == [
            ".../train.py",
            "output=./run",
            "demos.file=~/my data/d.hdf5",
            "demos.file=.../d.hdf5",
            "a=b/c",
        ]
        assert session["outcome"] == "failed: OSError: no space for ~/elsewhere/file"


@pytest.mark.parametrize(
    ("said", "private"),
    [
        # With the sign that ends a key, in a word or in place of one.
        ("output=/home/bob/lr=0.1/c", "output=.../c"),
        ('resume="/home/bob/a=b/c"', "resume=.../c"),
        ("/home/bob/a=b/train.py", ".../train.py"),
        ("--config-dir=/home/bob/a=b/c", "--config-dir=.../c"),
        ("hydra/launcher=ray", "hydra/launcher=ray"),
        # With blanks: of the user's own, of others.
        ("a={file:{home}/my data/d.hdf5}", "a={file:~/my data/d.hdf5}"),
        ("output=/mnt/jo smith/c", "output=.../c"),
        ("seeds=[{work}/a,{home}/b,/mnt/c]", "seeds=[./a,~/b,.../c]"),
        # In what follows a flag or stands in a link.
        ("compiler=g++ -I/home/bob/x -L/home/bob/lib", "compiler=g++ -I.../x -L.../lib"),
        ("-I{home}/x", "-I~/x"),
        ("url=file:///home/bob/x", "url=file://.../x"),
        ("url=https://host.org/a/b", "url=https://host.org/a/b"),
    ],
)
def test_paths_of_the_command_line_are_shortened(
    tmp_path, small_config, monkeypatch, said, private
):
    home, work = tmp_path / "jo smith", tmp_path / "jo smith/project"
    work.mkdir(parents=True)
    monkeypatch.chdir(work)
    monkeypatch.setenv("HOME", str(home))
    said = said.replace("{home}", str(home)).replace("{work}", str(work))
    monkeypatch.setattr(sys, "argv", ["train.py", said])
    made = record(small_config(), tmp_path / "run")
    assert made["sessions"][0]["command"][2] == private


def test_the_users_folder_may_be_the_working_folder_or_inside_it(tmp_path, monkeypatch):
    home = tmp_path / "bob"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    text = f"no space (1 / 2) for {home}/run, nor in {home}."
    for folder in (tmp_path, Path("/"), home):
        monkeypatch.chdir(folder)
        assert without_paths(text) == "no space (1 / 2) for ~/run, nor in ~."
    assert without_paths(f"{home}by/run {home}-2/run") == ".../run .../run"  # of others
    assert without_paths("'/mnt/my disk/d.hdf5': gone") == "'.../d.hdf5': gone"


def damaged(record: dict, damage: str) -> str:
    """A record that was whole: with a key less, or with a value of another kind."""
    session = record["sessions"][0]
    if damage == "format":
        record["format"] = 2
    elif damage == "code":
        session["code"] = {"commit": "0", "of": "equirl", "dirty": False, "changes": None}
    elif damage.startswith("no "):
        del session[damage.removeprefix("no ")]
    else:
        session[damage] = []
    return json.dumps(record)


@pytest.mark.parametrize(
    "damage",
    [
        *("", "{", "[]", '{"sessions": [{}]}', '{"sessions": []}', "format", "versions", "code"),
        *("no outcome", "no minutes", "minutes", "no started", "started", "no first_step"),
    ],
)
def test_a_damaged_record_does_not_keep_a_run_from_going_on(tmp_path, small_config, damage, caplog):
    if damage.removeprefix("no ").isidentifier():
        whole = record(small_config(), tmp_path)
        damage = damaged(whole, damage)
    (tmp_path / "run.json").write_text(damage)
    assert read_record(tmp_path) is None
    made = record(small_config(), tmp_path)
    assert len(made["sessions"]) == 1
    assert "run.json cannot be read" in caplog.text


def test_an_interrupted_writing_leaves_the_record_before(tmp_path, small_config, monkeypatch):
    """The record is replaced as a whole."""
    record(small_config(), tmp_path)
    before = (tmp_path / "run.json").read_text()

    def cut_short(path, text):
        with open(path, "w") as file:
            file.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", cut_short)
    with pytest.raises(OSError, match="No space left"):
        record(small_config(), tmp_path)
    assert (tmp_path / "run.json").read_text() == before
