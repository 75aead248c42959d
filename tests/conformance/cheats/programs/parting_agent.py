"""An agent that plays one honest submit and leaves traps behind for what comes after it: who scores the run, who
reports it.

Started as `python parting_agent.py HOW OUTSIDE`: what it leaves in place of `system/`, and a folder that is not its
own.
"""

import contextlib
import json
import os
import shutil
import socket
import sys
import urllib.request

how, outside = sys.argv[1:]


def nest(folder, depth=1100):
    """Folders in folders, deeper than recursion goes."""
    here = os.open(folder, os.O_RDONLY)
    for _ in range(depth):
        os.mkdir("d", dir_fd=here)
        inner = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    os.close(here)


with open("system/.bashrc", "w") as file:
    file.write("# run by whoever owns the folder\n")
request = urllib.request.Request(
    os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": [0]}).encode()
)
urllib.request.urlopen(request).read()

# A run in the run: its own word for how good it was.
os.makedirs("extra/logs")
os.makedirs("extra/workspace")
with open("extra/run.json", "w") as file:
    file.write("{}")
# Names that act on a terminal, or are no text, and one file with two names.
for name in (b"\x1b]0;gone\x07\x1b[2Jname\nsubmit_000", b"\xff\xfe.png", "\u202egnp.exe".encode()):
    with open(name, "w") as file:
        file.write("x")
os.link("extra/run.json", "same.json")
os.mkfifo("extra/pipe")
# Images that are none, for a report that shows images.
os.mkfifo("plot.png")
os.symlink("/etc/passwd", "passwd.png")
os.symlink(outside, "elsewhere")
os.symlink("loop", "loop")
with open("huge.png", "wb") as file:
    file.truncate(1 << 40)
for folder in (".", os.path.expanduser("~")):
    nest(folder)

if how == "as it is":
    pass
elif how == "deep":
    nest("system")
else:
    shutil.rmtree("system")
    if how == "pipe":
        os.mkfifo("system")
    elif how == "socket":
        with contextlib.closing(socket.socket(socket.AF_UNIX)) as sock:
            sock.bind("system")
    elif how == "link":
        os.symlink(outside, "system")
os.chmod(".", 0)
