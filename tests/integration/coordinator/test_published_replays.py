"""`evopolicy check --replay` of an environment that does not repeat episodes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import agent, evopolicy, words

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[3]
AGENT = """
submit_policy('''
class Policy:
    def __init__(self, obs_space, action_space, env_meta): pass
    def reset(self, episode_index): pass
    def act(self, obs): return float(obs[0]) / 2
''', [0, 1])
"""


def test_an_environment_that_does_not_repeat_episodes_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The installed package defines it so; the published file's own statement does not count."""
    package = tmp_path / "plugin" / "acme_moody"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(
        "import gymnasium\ngymnasium.register('Moody-v0', entry_point='acme_envs:Glider', max_episode_steps=5)\n"
    )
    (package / "environments.toml").write_text(
        'id = "acme/moody"\ngymnasium_id = "acme_moody:Moody-v0"\ndeterministic = false\n'
    )
    info = tmp_path / "plugin" / "acme_moody-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-moody\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[evopolicy.environments]\nacme = acme_moody:environments.toml\n")
    monkeypatch.setenv("PYTHONPATH", f"{package.parent}:{ROOT / 'tests/support/foreign_package'}")
    own = ("--agent", agent(tmp_path, AGENT), "--entry", "mine")
    numbers = words("--env acme/moody --budget 5 --validation 1 --heldout 1 --state st")
    evopolicy(tmp_path, "local", *numbers, *own, code=0)
    evopolicy(tmp_path, *words("publish runs --out results.evp --local --state st"), code=0)
    done = evopolicy(tmp_path, *words("check results.evp --json --replay all"), code=3)
    (played,) = [each for each in json.loads(done.stdout)["findings"] if each["kind"] == "replay"]
    assert played["state"] == "open"
    assert "acme/moody is marked as not deterministic" in played["text"]
