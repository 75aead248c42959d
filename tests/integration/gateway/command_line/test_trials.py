"""`evopolicy try`: cases played outside any run."""

from __future__ import annotations

import json
from pathlib import Path

from commands import ended


def test_try_shows_returns_and_where_the_trajectories_are(operator_file: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "policy.py").write_text(
        "class Policy:\n"
        "  def __init__(self, obs_space, action_space, env_meta): pass\n"
        "  def reset(self, i): print('hello from', i)\n"
        "  def act(self, obs): return [obs[2] - obs[0]]\n"
    )
    where = ["--env", "toy/line", "--credentials", str(operator_file)]
    out, _ = ended(tmp_path, "try", "mine", "--cases", "0-1,5", "--json", *where)
    (result,) = json.loads(out)
    assert [episode["case"] for episode in result["episodes"]] == [0, 1, 5]
    first = Path(result["episodes"][0]["folder"])
    assert len((first / "trajectory.jsonl").read_text().splitlines()) == result["episodes"][0]["length"]
    assert "hello from" in (first / "stdout.txt").read_text()
    (tmp_path / "mine" / "policy.py").write_text("import nothing_like_it\n")
    out, _ = ended(tmp_path, "try", "mine", "--cases", "0", *where, ends=1)
    assert "nothing_like_it" in out


def test_try_leaves_cases_with_a_failure_out_of_the_mean(operator_file: Path, tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text(
        "class Policy:\n"
        "  def __init__(self, obs_space, action_space, env_meta): pass\n"
        "  def reset(self, i): self.i, self.t = i, 0\n"
        "  def act(self, obs):\n"
        "    self.t += 1\n"
        "    if self.i == 1 and self.t == 3: raise ValueError('[/x] \\x1b[2J broken')\n"
        "    return [obs[2] - obs[0]]\n"
    )
    where = ["--env", "toy/line", "--credentials", str(operator_file), "--cases", "0-2"]
    out, _ = ended(tmp_path, "try", ".", "--json", *where, ends=1)
    (result,) = json.loads(out)
    returns = [episode["episode_return"] for episode in result["episodes"]]
    assert [episode["failed_at"] for episode in result["episodes"]] == [None, 2, None]
    assert result["mean_return"] == (returns[0] + returns[2]) / 2
    assert (result["n_failed"], result["other_cases_next_time"]) == (1, False)
    out, _ = ended(tmp_path, "try", ".", *where, ends=1)
    assert "policy to step 2, then random" in out
    assert "[/x] \ufffd[2J broken" in out
    assert "over 2 of 3 cases; 1 case left out, in which the policy failed" in out
