"""Keys of a run's command line and variables: what is recorded and published of them.

Attacks, each with its defence:
- a key that the agent got is in a policy or recording that is published: its look, or a keyed digest of it,
  is searched for; a match stops the publication before cases are disclosed, unless its file is left out or
  its line accepted.
"""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest
from commands import agent, evopolicy, words
from publications import read

KEY = "sk-" + "a1B2c3D4e5" * 3
PLAIN = "hunter2 hunter2"
PASSED = "correct horse battery staple"
AGENT = """
print(json.dumps({"got": sys.argv[1:]}), file=sys.stderr)
assert sys.argv[1:] == json.loads(os.environ["EXPECTED"])
with open("system/policy.py") as file:
    old = file.read()
for text in (f"# {os.environ['PHRASE']}\\n", "# harmless\\n"):
    submit_policy("import numpy\\n" + text + old, [0])
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose agent got keys on its command line and a phrase in a variable, which it wrote into a policy."""
    root = tmp_path_factory.mktemp("secrets")
    agent(root, AGENT)
    secrets = ["--api-key", KEY, f"--token={PLAIN}", "-k", PLAIN, "--depth", "3"]
    program = f"command:python3 agent.py --api-key {KEY} '--token={PLAIN}' -k '{PLAIN}' --depth 3"
    options = words("--env toy/line --budget 2 --validation 2 --heldout 2 --state st --runs runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHRASE", PASSED)
        patch.setenv("EXPECTED", json.dumps(secrets))
        passed = words("--jail-env PHRASE --jail-env EXPECTED")
        evopolicy(root, "local", *options, *passed, "--agent", program, code=0)
    return next(root.glob("runs/*/*/*/run.json")).parent


def publish(folder: Path, out: str, *more: str) -> tuple[int, str]:
    root = folder.parents[3]
    done = evopolicy(root, "publish", "runs", "--out", out, "--local", "--state", "st", *more)
    return done.returncode, done.stdout + done.stderr


def is_revealed(root: Path) -> bool:
    """Whether the journal of the state folder says that cases are public."""
    return any(b"revealed" in path.read_bytes() for path in (root / "st").glob("coordinator.sqlite*"))


def test_keys_of_a_command_line_reach_the_agent_and_no_file(folder: Path) -> None:
    record = json.loads((folder / "run.json").read_bytes())
    program = record["agent"]["settings"]["program"]
    assert program[-7:] == words("--api-key [redacted] --token=[redacted] -k [redacted] --depth 3")
    files = [path for path in folder.parents[2].rglob("*") if path.is_file()]
    for path in files:
        assert KEY.encode() not in path.read_bytes(), path
        assert PLAIN.encode() not in path.read_bytes(), path
    assert '{\\"got' in (folder / "logs" / "agent.jsonl").read_text()
    private = folder / ".passed.json"
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert PASSED.encode() not in private.read_bytes()


@pytest.mark.system
def test_a_passed_value_in_a_policy_stops_publish_until_decided(folder: Path) -> None:
    root = folder.parents[3]
    place = f"{folder.relative_to(root)}/checkpoints/submit_000/policy.py:2"
    code, text = publish(folder, "stopped.evp")
    said = "".join(text.split())
    assert (code, "".join(place.split()) in said) == (2, True), text
    assert PASSED not in text
    assert not (root / "stopped.evp").exists()
    # Nothing was disclosed: the next run plays cases of the same epoch.
    assert not is_revealed(root)

    code, text = publish(folder, "other.evp", "--accept-finding", place.replace(":2", ":3"))
    assert code == 2, text
    code, text = publish(folder, "removed.evp", "--remove-findings", "--with-logs")
    assert code == 0, text
    assert is_revealed(root)
    code, text = publish(folder, "accepted.evp", "--accept-finding", f"./{place}")
    assert code == 0, text
    held = {name: read(root / name) for name in ("removed.evp", "accepted.evp")}
    assert not any(".passed.json" in each for files in held.values() for each in files)
    assert not any(PASSED.encode() in data for data in held["removed.evp"].values())
    policies = {name: {each for each in files if "/checkpoints/" in each} for name, files in held.items()}
    assert policies["removed.evp"] == {"runs/0000/checkpoints/001"}
    assert policies["accepted.evp"] == {"runs/0000/checkpoints/000", "runs/0000/checkpoints/001"}
    assert any(PASSED.encode() in data for data in held["accepted.evp"].values())
