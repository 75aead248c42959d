"""`evopolicy check --policies`: policies that declare themselves deterministic are played again; others are not.

Attacks, each with its defence:
- actions that the policy did not choose: `--policies` finds them if the policy declares itself deterministic;
  otherwise nothing does.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from commands import agent, evopolicy, words

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[3]
AGENT = """
POLICY = '''
import random
class Policy:
    DECLARED
    def __init__(self, obs_space, action_space, env_meta):
        self.left = env_meta["remaining_budget_after"]
    def reset(self, episode_index):
        self.number = episode_index
    def act(self, obs):
        return ACTION
'''
kinds = {
    "honest": ("deterministic = True", "float(obs[0]) / 2 + self.number / 8 + self.left / 64"),
    "lying": ("deterministic = True", "random.random()"),
    "silent": ("deterministic = 1", "random.random()"),
}
declared, action = kinds[sys.argv[1]]
text = POLICY.replace("DECLARED", declared).replace("ACTION", action)
submit_policy(text, [0, 1, 0])
submit_policy(text + "#", [2, 3])
"""


def findings(cwd: Path, *options: str, kind: str = "policies") -> tuple[int, list[dict[str, Any]]]:
    done = evopolicy(cwd, "check", "results.evp", "--json", *options)
    assert done.stdout, done.stderr
    played = [each for each in json.loads(done.stdout)["findings"] if each["kind"] == kind]
    return done.returncode, played


@pytest.mark.timeout(900)
@pytest.mark.parametrize("scope", ["episode", "submit"])
def test_deterministic_policies_give_the_recorded_actions_and_a_false_declaration_is_named(
    tmp_path: Path, scope: str
) -> None:
    program = agent(tmp_path, AGENT)
    numbers = words(
        f"--env toy/line --state st --budget 5 --validation 3 --heldout 4 --set policy_scope={scope}"
    )
    for kind in ("honest", "lying", "silent"):
        own = ("--agent", f"{program} {kind}", "--entry", kind, "--exp-id", kind)
        evopolicy(tmp_path, "local", *numbers, *own, code=0)
    done = evopolicy(tmp_path, "publish", "runs", "--out", "results.evp", "--local", "--state", "st", code=0)
    runs = {
        json.loads(path.read_text())["run"]: json.loads(path.read_text())["agent"]["entry"]
        for path in tmp_path.glob("runs/*/*/*/run.json")
    }

    code, played = findings(tmp_path)
    assert (code, {each["state"] for each in played}) == (0, {"open"})
    code, played = findings(tmp_path, "--policies", "all")
    assert code == 1
    by_entry: dict[str, list[dict[str, Any]]] = {}
    for each in played:
        by_entry.setdefault(runs[each["run"]], []).append(each)
    # 5 train episodes, 3 validation cases of both checkpoints, 4 held-out ones.
    (honest,) = by_entry["honest"]
    assert (honest["state"], honest["text"].split()[0]) == ("ok", "15")
    assert {each["state"] for each in by_entry["lying"]} == {"failed"}
    assert len(by_entry["lying"]) == 15
    assert "gave other actions: at step 0" in by_entry["lying"][0]["text"]
    (silent,) = by_entry["silent"]
    assert (silent["state"], "do not declare" in silent["text"]) == ("open", True)
    done = evopolicy(tmp_path, "check", "results.evp", "--policies", "some")
    assert (done.returncode, "--policies 'some'" in done.stderr) == (2, True)


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
    own = ("--agent", f"{agent(tmp_path, AGENT)} honest", "--entry", "mine")
    numbers = words("--env acme/moody --budget 5 --validation 1 --heldout 1 --state st")
    evopolicy(tmp_path, "local", *numbers, *own, code=0)
    evopolicy(tmp_path, *words("publish runs --out results.evp --local --state st"), code=0)
    for option, kind, wanted in (("--replay", "replay", 3), ("--policies", "policies", 0)):
        code, played = findings(tmp_path, option, "all", kind=kind)
        assert (code, [each["state"] for each in played]) == (wanted, ["open"]), played
        assert "acme/moody is marked as not deterministic" in played[0]["text"]
