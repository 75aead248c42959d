"""Leaves data wherever it can, for its agent and for its own next episodes, and looks for what others of its kind left.

It says what it did on its output, which the protocol hands on from train episodes. `AGENT` is filled in by its agent:
where that agent looks.
"""

import glob
import json
import os
import random
import socket
import sys

AGENT = {}
NAME = "left-behind"
MARK = f"mark-{random.SystemRandom().getrandbits(64):x}-of-an-episode"


def places():
    """Folders to leave a file in: the policy's own, the system's, its agent's."""
    own = {os.getcwd(), os.path.dirname(os.path.abspath(__file__)), os.path.expanduser("~"), *sys.path}
    return sorted(own | {"/tmp", "/var/tmp", "/dev/shm", "/run", "/dev/mqueue", *AGENT.get("folders", ())})


def leave():
    """What it came to leave."""
    done = []
    for folder in places():
        try:
            with open(os.path.join(folder, f"{NAME}-{os.getpid()}"), "w") as file:
                file.write(MARK)
            done.append(folder)
        except OSError:
            pass
    os.environ[NAME] = MARK
    sys.modules[NAME] = MARK
    return done


def call_the_agent():
    """Its port on loopback, and its socket by name."""
    reached = []
    for family, address in (
        (socket.AF_INET, ("127.0.0.1", AGENT.get("port", 9))),
        (socket.AF_UNIX, "\0" + NAME),
    ):
        try:
            with socket.socket(family) as sock:
                sock.settimeout(2)
                sock.connect(address)
                sock.sendall(MARK.encode())
                reached.append(str(address))
        except OSError:
            pass
    return reached


def found():
    """Traces of other episodes: files, names, variables, modules."""
    traces = [path for folder in places() for path in glob.glob(os.path.join(folder, f"{NAME}*"))]
    return traces + [name for name in (*os.environ, *sys.modules) if name.startswith(NAME)]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        before = found()
        report = {"mark": MARK, "before": before, "left": leave(), "reached": call_the_agent()}
        print("REPORT " + json.dumps(report), flush=True)

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return [0.0]
