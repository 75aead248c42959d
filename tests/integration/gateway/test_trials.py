"""`evopolicy try` and `evopolicy random`: cases played outside any run."""

from __future__ import annotations

import json
from pathlib import Path

from commands import command


def test_try_shows_returns_and_where_the_trajectories_are(operator_file: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "policy.py").write_text(
        "class Policy:\n"
        "  def __init__(self, obs_space, action_space, env_meta): pass\n"
        "  def reset(self, i): print('hello from', i)\n"
        "  def act(self, obs): return [obs[2] - obs[0]]\n"
    )
    where = ["--env", "toy/line", "--credentials", str(operator_file)]
    with command(tmp_path, "try", "mine", "--cases", "0-1,5", "--json", *where) as running:
        code, out, err = running.finish()
    assert code == 0, err
    (result,) = json.loads(out)
    assert [episode["case"] for episode in result["episodes"]] == [0, 1, 5]
    first = Path(result["episodes"][0]["folder"])
    assert len((first / "trajectory.jsonl").read_text().splitlines()) == result["episodes"][0]["length"]
    assert "hello from" in (first / "stdout.txt").read_text()
    (tmp_path / "mine" / "policy.py").write_text("import nothing_like_it\n")
    with command(tmp_path, "try", "mine", "--cases", "0", *where) as running:
        code, out, _ = running.finish()
    assert code == 1
    assert "nothing_like_it" in out


def test_random_plays_the_reference_on_a_split(operator_file: Path, tmp_path: Path) -> None:
    where = ["--env", "toy", "--cases", "0-3", "--json", "--credentials", str(operator_file)]
    with command(tmp_path, "random", *where) as running:
        code, out, err = running.finish()
    assert code == 0, err
    assert [(result["env"], len(result["episodes"])) for result in json.loads(out)] == [
        ("toy/line", 4),
        ("toy/maze", 4),
    ]
