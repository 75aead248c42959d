"""Examples that messages name are found wherever a command is started, also from a wheel."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from evopolicy_gateway import shipped

ROOT = Path(__file__).parents[3]


def test_an_example_is_found_anywhere_and_a_users_own_file_goes_first(tmp_path: Path) -> None:
    name = "examples/policies/gym_acrobot"
    assert (shipped.found(name, tmp_path) / "policy.py").is_file()
    own = tmp_path / name
    own.mkdir(parents=True)
    assert shipped.found(name, tmp_path) == own
    assert shipped.found("my_policy", tmp_path) == tmp_path / "my_policy"
    assert shipped.found("examples/none", tmp_path) == tmp_path / "examples/none"


def test_a_wheel_has_the_examples_in_their_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    # Installed as the wheel says, with no checkout around it.
    package = tmp_path / "evopolicy_gateway"
    for source, target in wheel["force-include"].items():
        assert (ROOT / source).exists(), source
        (tmp_path / target).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / target).symlink_to(ROOT / source)
    monkeypatch.setattr(shipped, "__file__", str(package / "shipped.py"))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for source in wheel["force-include"]:
        assert shipped.found(source, elsewhere) == package / source
    assert shipped.found("docs/none.md", elsewhere) == elsewhere / "docs/none.md"
