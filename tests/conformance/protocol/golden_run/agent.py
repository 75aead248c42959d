import json, os, sys, urllib.request, urllib.error

GOOD = '''import json
import math
from pathlib import Path

from helpers.gain import gain


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.gain = gain(json.loads(Path("table.json").read_text()))

    def reset(self, episode_index):
        self.scale = math.copysign(1.0, 0.5 - episode_index % 2)

    def act(self, obs):
        return [self.gain * self.scale] if obs[0] > 0 or self.scale < 0 else [0.25]
'''


def submit(ids):
    request = urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": ids}).encode())
    try:
        return json.load(urllib.request.urlopen(request))
    except urllib.error.HTTPError as error:
        return json.load(error)


print(json.dumps(submit("0-1")["status"]), flush=True)
os.mkdir("system/helpers")
open("system/helpers/gain.py", "w").write("def gain(table):\n    return sum(table) / len(table) if table else 0.0\n")
open("system/table.json", "w").write("[0.5, -1.0]")
open("system/policy.py", "w").write(GOOD)
submit([2, 3, 3])
open("system/policy.py", "w").write("raise RuntimeError('no')\n")
submit([0])
submit([0, 99])
open("system/policy.py", "w").write(GOOD.replace("0.25", "-0.25"))
submit([4, 5])
