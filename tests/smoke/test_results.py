"""The scripts behind the pages of results."""

import importlib
import re

import pytest
import torch

from equirl.modules import METHODS
from equirl.symmetry import random_observations
from tests.commands import ROOT, SMOKE

RESULTS = ROOT / "experiments" / "results"
NAME = "paper_networks:PAPER_NETWORKS"


@pytest.fixture(autouse=True)
def scripts(monkeypatch, tmp_path):
    for page in ("modes", "stability"):
        monkeypatch.syspath_prepend(RESULTS / page)
    monkeypatch.chdir(tmp_path)


def test_the_papers_networks_in_a_strict_run(here, tmp_path, capsys):
    run = tmp_path / "run"
    code, _, err = here("train.py", *SMOKE, f"method.name={NAME}", f"output={run}")
    assert code == 0, err
    importlib.import_module("probe").main(str(run), 2)
    printed = capsys.readouterr().out
    played = re.findall(r"^(\w+), (\w+): (\d) of 2 succeed; (\d) of (\d) failures", printed, re.M)
    assert [line[:2] for line in played] == [
        ("average", "mean"),
        ("average", "sample"),
        ("actor", "mean"),
        ("actor", "sample"),
    ]
    assert all(int(won) + int(lost) == 2 and alike <= lost for *_, won, alike, lost in played)
    last = re.findall(r"^1 (\S+) \S+ \S+$", printed, re.M)
    assert last == ["1.00"]  # both episodes of the expert end with the reward


def test_they_are_those_of_paper_mode():
    options = {"hidden": 8, "image_size": 16, "group": "D4", "backend": "dense"}
    data = random_observations(3, 16).select("depth", "holding")

    def scales(name: str, mode: str) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        actor = METHODS[name].make_actor(**options, mode=mode, generator=generator)
        with torch.no_grad():
            return actor(data.clone())["scale"]

    assert torch.equal(scales(NAME, "strict"), scales("equivariant", "paper"))
    assert not torch.equal(scales(NAME, "strict"), scales("equivariant", "strict"))
