"""An agent whose policy leaves it data: it listens, and looks into every folder that it has, after its submits.

Started as `python listening_agent.py POLICY`. Its report: `report.json`.
"""

import glob
import json
import os
import socket
import sys
import urllib.request

folders = [os.getcwd(), "/tmp", "/dev/shm", os.path.expanduser("~")]
tcp = socket.create_server(("127.0.0.1", 0))
unix = socket.socket(socket.AF_UNIX)
unix.bind("\0left-behind")
unix.listen()
with open(sys.argv[1]) as file:
    policy = file.read()
agent = {"folders": folders, "port": tcp.getsockname()[1]}
with open("system/policy.py", "w") as file:
    file.write(policy.replace("AGENT = {}", f"AGENT = {agent!r}"))
for ids in ([0, 0], [1]):
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": ids}).encode()
    )
    urllib.request.urlopen(request).read()
called = []
for sock in (tcp, unix):
    sock.settimeout(0.5)
    try:
        peer, _ = sock.accept()
        called.append(peer.recv(100).decode())
    except TimeoutError:
        pass
files = [path for folder in folders for path in glob.glob(os.path.join(folder, "left-behind*"))]
reports = []
for path in sorted(glob.glob("feedback/submit_*/episodes/*/stdout.txt")):
    with open(path) as file:
        reports += [json.loads(line.removeprefix("REPORT ")) for line in file if line.startswith("REPORT ")]
with open("report.json", "w") as file:
    json.dump({"called": called, "files": files, "reports": reports}, file)
