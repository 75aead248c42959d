"""Agents that speak the published protocol, each in another legal way, with the standard library alone.

Each checks what it is told and dies with a traceback where that is not as published. `COMMON` comes before each.
"""

from __future__ import annotations

COMMON = """
import json, os, sys, time, urllib.error, urllib.request
from pathlib import Path

API = os.environ["EVOPOLICYGYM_API"]

def ask(path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(API + path, data=data, headers={"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read() or b"{}")

def submit(ids, **more):
    return ask("/submit", {"env_instances": ids, **more})

def spend_all():
    left = ask("/info")[1]["state"]["remaining_budget"]
    if left:
        assert submit([0] * left)[1]["is_finalized"] is True
"""

LIST_POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        assert env_meta["max_episode_steps"] > 0
        self.played = 0
        self.low, self.high = action_space["low"], action_space["high"]

    def reset(self, episode_index):
        self.played += 1
        print("episode", self.played, "of this Policy")

    def act(self, obs):
        assert obs == [float(number) for number in obs] and obs + [0.0]
        if obs and obs[2] > obs[0]:
            return self.high
        return None if self.played == 2 else self.low
"""

VARIABLES = f"""
system, feedback = Path(os.environ["EVOPOLICYGYM_SYSTEM"]), Path(os.environ["EVOPOLICYGYM_FEEDBACK"])
workspace, agents = Path(os.environ["EVOPOLICYGYM_WORKSPACE"]), Path(os.environ["EVOPOLICYGYM_AGENTS"])
assert Path.cwd() == workspace and system.parent == feedback.parent == agents.parent == workspace
assert os.environ["EVOPOLICYGYM_PROTOCOL"] == ask("/info")[1]["protocol_version"] == "protocol/v2.0-draft"
for name in ("INFO", "TASK", "SUBMIT"):
    assert os.environ[f"EVOPOLICYGYM_{{name}}_URL"] == f"{{API}}/{{name.lower()}}"
assert os.environ["EVOPOLICYGYM_SUBMIT_URL"] in agents.read_text()
(system / "policy.py").write_text({LIST_POLICY!r})
status, answer = submit([3, 3, 7], an_unknown_field={{"of": ["any", "kind"]}})
assert (status, answer["submit_id"], answer["status"]) == (200, 0, "ok"), answer
Path("answer.json").write_text(json.dumps(answer))
folder = feedback / "submit_000"
assert json.loads((folder / "summary.json").read_text()) == answer["summary"]
assert [path.name for path in sorted((folder / "episodes").iterdir())] == ["ep_000", "ep_001", "ep_002"]
spend_all()
"""

TURNS = """
for line in sys.stdin:
    prompt = json.loads(line)
    assert prompt["type"] == "prompt" and prompt["message"]
    answer = submit([prompt["turn"]])[1]
    last = answer["is_finalized"]
    print(json.dumps({"turn": prompt["turn"], "text": answer["status"], "stop": last}), flush=True)
"""

BARE = """
# No field, fields of its own, a count of its own, an answer that comes twice, words of its own in between.
answers = ['{}', '{"text": "two", "mine": [1]}', '{"turn": 3}\\n{"turn": 1}', 'four\\n[4]\\n{"stop": false}', '{"stop": true}']
for number, line in enumerate(sys.stdin):
    if number == 3:
        spend_all()
    print(answers[number], flush=True)
"""  # noqa: E501

REQUESTS = """
task = urllib.request.urlopen(os.environ["EVOPOLICYGYM_TASK_URL"]).read().decode()
assert task.startswith("# ")
info = ask("/info")[1]
assert info["env_meta"]["n_env_instances"] == 1024 and info["state"]["is_finalized"] is False
for wrong, status in (([], "budget_invalid"), ([0] * 99, "budget_invalid"), ([1024], "invalid_env_instance"),
                      ("3-1", "invalid_env_instance"), ([-1], "invalid_env_instance")):
    code, answer = submit(wrong)
    assert (code, answer["status"]) == (400, status), (wrong, answer)
assert ask("/info")[1]["state"] == {"remaining_budget": info["episode_budget"], "n_submits": 0, "is_finalized": False}
answer = submit("1022-1023,0")[1]
assert answer["submit_id"] == 0
assert answer["summary"]["env_instances"] == [1022, 1023, 0] and answer["is_finalized"] is False
assert ask("/finalize", {})[0] == 405
spend_all()
assert ask("/info")[1]["state"] | {"n_submits": 0} == {"remaining_budget": 0, "n_submits": 0, "is_finalized": True}
assert "left" not in ask("/info")[1]
code, answer = submit([0])
assert (code, answer["status"]) == (409, "run_closed")
time.sleep(1000)  # and it is ended, after a time that AGENTS.md tells
"""

FAILS = f"""
system, good = Path(os.environ["EVOPOLICYGYM_SYSTEM"]), {LIST_POLICY!r}
(system / "policy.py").write_text(good.replace("self.played += 1", "self.played += 1; assert self.played != 2"))
answer = submit([0, 1])[1]
assert (answer["status"], answer["summary"]["errors"]) == ("rollout_timeout", [1]), answer
assert answer["summary"]["episode_lengths"][1] == 0 and answer["summary"]["mean_return"] is None
# It fails beyond its submit's episodes, as only hidden evaluation has that many.
(system / "policy.py").write_text(good.replace("self.played += 1", "self.played += 1; assert episode_index < 1"))
assert submit([0])[1]["status"] == "ok"
(system / "policy.py").write_text(good)
spend_all()
"""

EARLY_STOP = """
line = json.loads(sys.stdin.readline())
submit([0])
print(json.dumps({"turn": line["turn"], "stop": True}), flush=True)
"""

EARLY_EXIT = "submit([0])"

SAYS_NOTHING = """
submit([0])
while True:
    time.sleep(0.3)
    print("still here", flush=True)
"""

DIES = """
submit([0])
os.kill(os.getpid(), 9)
"""

FLOODS = """
# It never reads its stdin, which fills, and prints objects that nobody has asked for.
for _ in range(300):
    print(json.dumps({"log": "x" * 300}), flush=True)
spend_all()
"""

NOT_PUBLISHED_IDS = """
code, answer = submit([100])
assert (code, answer["status"]) == (400, "invalid_env_instance") and "0 to 63" in answer["error"]["message"], answer
"""
