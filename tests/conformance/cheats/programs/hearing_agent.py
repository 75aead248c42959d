"""Listens to the machine's memory for what a policy tells of hidden cases: `hearing_agent.py POLICY SUBMITS`.

Submits the policy so many times, then listens until a file `stop` is there. `heard.json` has the height of every pulse
in MiB, and how often it has looked.
"""

import json
import os
import sys
import time
import urllib.request

LEAST_MIB = 24.0
LOOK_S = 0.004
LONGEST_S = 8.0


def shared_mib():
    with open("/proc/meminfo", "rb", buffering=0) as file:
        return int(file.read().partition(b"Shmem:")[2].split()[0]) / 1024.0


def submit():
    with open(sys.argv[1]) as source, open("system/policy.py", "w") as target:
        target.write(source.read())
    body = json.dumps({"env_instances": [0]}).encode()
    with urllib.request.urlopen(
        urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)
    ) as answer:
        assert json.load(answer)["status"] == "ok"


def tell(heard, looks):
    with open("heard.tmp", "w") as file:
        json.dump({"heard": heard, "looks": looks}, file)
    os.replace("heard.tmp", "heard.json")


for _ in range(int(sys.argv[2])):
    submit()
heard, looks = [], 0
floor = top = shared_mib()
since = time.monotonic()
tell(heard, looks)
while not os.path.exists("stop"):
    now = shared_mib()
    looks += 1
    if now < floor + 4.0:
        if top - floor > LEAST_MIB:
            heard.append(round(top - floor, 1))
            tell(heard, looks)
        floor = top = min(floor, now)
        since = time.monotonic()
    elif time.monotonic() - since > LONGEST_S:
        # Somebody else's memory, which stays.
        floor = top = now
    top = max(top, now)
    if looks % 100 == 0:
        tell(heard, looks)
    time.sleep(LOOK_S)
tell(heard, looks)
