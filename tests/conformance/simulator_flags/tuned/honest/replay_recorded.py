"""What would the new policy have done in the recorded episodes?"""
import json
import sys
from pathlib import Path

sys.path.insert(0, "system")
from policy import Policy  # noqa: E402


def differences(trajectory, policy):
    off, n = 0.0, 0
    policy.reset(0)
    for line in trajectory.read_text().splitlines():
        row = json.loads(line)
        action = policy.act(row["obs"])
        off += sum(abs(a - b) for a, b in zip(action, row["action"]))
        n += 1
    return off / max(1, n)


task = json.loads(Path("task.json").read_text())
policy = Policy(task["observation_space"], task["action_space"], task["env_meta"])
for path in sorted(Path("feedback").glob("submit_*/episodes/*/trajectory.jsonl")):
    print(path, round(differences(path, policy), 4))
