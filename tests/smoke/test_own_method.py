"""The how-to of docs/adding_a_method.md, followed to the letter."""

import re

import pytest
import torch

from equirl.modules import METHODS
from equirl.symmetry import random_observations
from tests.commands import ROOT, SMOKE

PAGE = (ROOT / "docs" / "adding_a_method.md").read_text()
CODE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
FAULTY = {
    "unclosed": "one = 1\ntwo = (",
    "divided": "import math\n\ndef half(of): return of / 0\n\nKEYPOINTS = half(1)",
    "halves": "import math\n\nimport other_half",
}
METHOD = "method.name=my_methods:KEYPOINTS"


@pytest.fixture(autouse=True)
def saved(tmp_path, monkeypatch):
    (tmp_path / "my_methods.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)


def test_a_method_in_a_file_of_ones_own(here, tmp_path):
    def script(name: str, *arguments: str) -> str:
        code, out, err = here(name, *arguments)
        assert code == 0, err
        return out

    run = tmp_path / "run"
    script("train.py", *SMOKE, METHOD, "algorithm=sacfd", f"output={run}")
    assert "KEYPOINTS SACfD" in (run / "report.md").read_text().splitlines()[0]
    assert "of 2 episodes succeed" in script("evaluate.py", f"run={run}", "episodes=2")
    script("train.py", f"resume={run}", "steps=32")
    assert "my_methods:KEYPOINTS" in (run / "config.yaml").read_text()


def test_its_features_are_where_things_are():
    """The example is what its page says: a point that moves in the picture moves in them."""
    method = METHODS["my_methods:KEYPOINTS"]
    actor = method.make_actor(hidden=8, image_size=16, generator=torch.Generator().manual_seed(0))
    encoder = actor.module[0].module.encoder
    data = random_observations(3, 16)
    features = encoder(data["depth"], data["holding"])
    assert features.shape == (3, encoder.out_features) and features.abs().max() <= 1
    turned = encoder(data["depth"].flip(-1), data["holding"])
    assert not torch.allclose(features, turned)
    again = method.make_actor(hidden=8, image_size=16, generator=torch.Generator().manual_seed(0))
    assert torch.equal(encoder.layers[0].weight, again.module[0].module.encoder.layers[0].weight)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("method.name=keypoints", "expected one of equivariant, cnn, drq, rad, ferm or"),
        ("method.name=my_methods:POINTS", "cannot be imported"),
        ("method.name=no_module:KEYPOINTS", "no_module"),
        ("method.name=.my_methods:KEYPOINTS", "'package.module:NAME', got '.my_methods:KEYPOINTS'"),
        (
            "method.name=unclosed:KEYPOINTS",
            "SyntaxError: '(' was never closed (unclosed.py, line 2)",
        ),
        (
            "method.name=divided:KEYPOINTS",
            "ZeroDivisionError: division by zero ({here}/divided.py, l",
        ),
        ("method.name=halves:KEYPOINTS", "No module named 'other_half' ({here}/halves.py, line 3)"),
        ("method.name=my_methods:KeypointEncoder", "must be an equirl.modules.methods.Method"),
    ],
)
def test_its_faults_are_told_in_a_sentence(here, tmp_path, name, complaint):
    for module, code in FAULTY.items():
        (tmp_path / f"{module}.py").write_text(code)
    code, _, err = here("train.py", *SMOKE, name)
    complaint = complaint.replace("{here}", str(tmp_path))
    assert code == 1 and "Traceback" not in err and complaint in err
