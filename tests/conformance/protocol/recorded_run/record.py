"""Records the run in this folder anew: `python tests/conformance/protocol/recorded_run/record.py`, from the root."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2] / "support"))

from stages.model_api import ModelApi, Step  # noqa: E402

AT = Path("/tmp/evopolicy-recorded-run")
"""The recorded agent saw its workspace below this path; a replay's jail shows it there again."""
PORTS = "20110 20190"
"""Below the range from which Linux takes ports by itself. A replay listens on two of them."""
POLICY = """class Policy:
    def __init__(self, *about):
        pass
    def reset(self, episode_index):
        self.step = 0
    def act(self, obs):
        self.step += 1
        return {actions}"""
SUBMIT = "curl -s -X POST -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL"
LOOK = "cat feedback/submit_*/summary.json; date"


def written(actions: str) -> Step:
    return Step(command=f"cat > system/policy.py <<'END'\n{POLICY.format(actions=actions)}\nEND\n{SUBMIT}")


SCRIPT = [
    Step(command="pwd; cat AGENTS.md; ls system"),
    written("3"),
    Step(command=LOOK),
    written("0 if self.step == 1 else 1 if self.step < 13 else 2"),
    Step(command=LOOK),
    written("2"),
    Step(text="The second policy is the best."),
]
"""Walks into the wall; along the cliff to the goal; and into another wall. No policy fails: the actions of such an
episode come from the secret of its coordinator."""


def main() -> None:
    if len(sys.argv) == 1:
        # A network of its own has a range of ports of its own. It needs root: in a user namespace of root's the
        # worker's sandbox cannot start.
        os.execvp("unshare", ["unshare", "-n", sys.executable, __file__, "inside"])
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    Path("/proc/sys/net/ipv4/ip_local_port_range").write_text(PORTS)
    shutil.rmtree(AT, ignore_errors=True)
    AT.mkdir()
    with ModelApi(SCRIPT) as api:
        table = f'[api]\nbase_url = "{api.base_url}/v1"\nkey = "MODEL_ACCESS"\n'
        (AT / "agent.toml").write_text(f'harness = "llm"\nmodel = "m-1"\n{table}')
        arguments = ["local", "--env", "gymnasium/CliffWalking-v1", "--agent", f"file:{AT}/agent.toml"]
        arguments += ["--entry", "recorded", "--exp-id", "first", "--record-model", "full"]
        arguments += ["--budget", "6", "--validation", "2", "--heldout", "2", "--data", str(HERE / "data")]
        environment = {**os.environ, "MODEL_ACCESS": "key-of-the-stand-in", "XDG_STATE_HOME": f"{AT}/xdg"}
        command = [sys.executable, "-m", "evopolicy_gateway.cli", *arguments, "--fresh"]
        subprocess.run(command, cwd=AT, env=environment, check=True)
    (run,) = (AT / "runs").glob("*/*/first")
    for text in (run / "run.json", run / "logs/agent.jsonl"):
        # Where this machine has its Python is nobody's business.
        text.write_text(text.read_text().replace(sys.executable, "/usr/bin/python3"))
    with tarfile.open(HERE / "run.tar.xz", "w:xz") as archive:
        archive.add(
            run, "run", filter=lambda member: member.replace(uid=0, gid=0, uname="", gname="", deep=False)
        )
    shutil.rmtree(AT)


if __name__ == "__main__":
    main()
