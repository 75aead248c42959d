"""An agent that has its gateway read other files for it: `system/` and what is in it change places with links, pipes
and hard links while a submit is taken. In a jail a link may point to what only the gateway sees: relative to the
workspace.

Its report: `report.json`, the status of each submit and what it was told.
"""

import contextlib
import itertools
import json
import os
import shutil
import threading
import urllib.request

SECRETS = ("../../.gateway/credentials.json", "../../../../../other/toy_line/t/checkpoints/policy.py")
"""From `system/`: the gateway's credentials, and another run's policy."""
with open("system/policy.py") as file:
    POLICY = file.read()
over = threading.Event()


def submit(ids):
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": ids}).encode()
    )
    with urllib.request.urlopen(request) as reply:
        document = json.load(reply)
    try:
        with open(os.path.join(document["feedback"], "errors.txt")) as errors:
            return document["status"], errors.read()
    except FileNotFoundError:
        return document["status"], ""


def write(path, text):
    with open(path, "w") as file:
        file.write(text)


def linked(path, target):
    with contextlib.suppress(FileExistsError):
        os.symlink(target, path)


def swap_files():
    """`policy.py` and a file beside it: a file, a link to a secret, a pipe, a hard link, a folder's link; again and
    again."""
    write("honest", POLICY)
    for number in itertools.count():
        if over.is_set():
            return
        name = ("policy.py", "data.bin")[number % 2]
        kind = number // 2 % 4
        with contextlib.suppress(OSError):
            if kind == 0:
                linked("next", SECRETS[number % len(SECRETS)])
            elif kind == 1:
                os.mkfifo("next")
            elif kind == 2:
                os.link("honest", "next")
            else:
                shutil.copy("honest", "next")
            os.replace("next", f"system/{name}")


def swap_folders():
    """`system` itself and a folder in it."""
    while not over.is_set():
        for folder, target in (("system", "../.gateway"), ("system/deep", "../../.gateway")):
            with contextlib.suppress(OSError):
                os.rename(folder, "away")
                linked(folder, target)
                os.unlink(folder)
            with contextlib.suppress(OSError):
                os.rename("away", folder)


def restore():
    for path in ("system", "away"):
        if os.path.islink(path):
            os.unlink(path)
        else:
            shutil.rmtree(path, ignore_errors=True)
    os.makedirs("system/deep")
    write("system/policy.py", POLICY)
    write("system/deep/more.py", "# mine\n")


restore()
verdicts = [submit([0])]
threads = [threading.Thread(target=swap) for swap in (swap_files, swap_folders)]
for thread in threads:
    thread.start()
verdicts += [submit([0]) for _ in range(8)]
over.set()
for thread in threads:
    thread.join()
for spoil in (
    lambda: (os.unlink("system/policy.py"), linked("system/policy.py", SECRETS[0])),
    lambda: (shutil.rmtree("system/deep"), linked("system/deep", "../../.gateway")),
    lambda: (shutil.rmtree("system"), linked("system", "../.gateway")),
    lambda: linked("system/loop", "loop"),
    lambda: os.link("honest", "system/more.py"),
    lambda: os.mkfifo("system/pipe"),
    lambda: [os.makedirs(f"system/many/{number}") for number in range(6000)],
):
    restore()
    spoil()
    verdicts.append(submit([0]))
restore()
verdicts.append(submit([0]))
with open("report.json", "w") as file:
    json.dump(verdicts, file)
