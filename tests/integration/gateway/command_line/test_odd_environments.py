"""Odd environments of users: what `evopolicy try` says of each, and that a refused one stops nothing but its own run.

Each row is a command with a cluster of its own. The first three are those that users meet most.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from commands import SMALL, command, ended

PACKAGE = Path(__file__).parents[3] / "support" / "odd_package"
POLICY = """
class Policy:
    def __init__(self, *spaces): pass
    def reset(self, episode_index): pass
    def act(self, obs): return [0.9]
"""
PLAYED = "mean return 20"
SOURCE = r'File "\S+odd_envs.py", line \d+, in '


class Row(NamedTuple):
    """A command and its output."""

    says: str
    """Regular expression for what the command prints."""
    env: str = "my/odd"
    file: str = ""
    """Lines of `odd.toml` besides id and gymnasium_id; empty: `env` needs no file."""
    options: tuple[str, ...] = ()
    code: int = 1


def does(what: str, says: str, *options: str, code: int = 1) -> Row:
    return Row(says, file=f'kwargs = {{ does = "{what}" }}', options=options, code=code)


TABLE = {
    "crash": does(
        "crash", rf"step 11: it raised ValueError: fell off the table; .*{SOURCE}crash_in_step_12: raise"
    ),
    "segfault": does("segfault", r"it was tried out; .*Segmentation fault.*odd_envs.py\", line \d+ in step"),
    "import": Row(
        r'No module named \'no_such_dependency\'.*File "\S+broken_import.py", line 3, in <module>: import no_such',
        env="broken_import:X-v0",
    ),
    "hang in reset": does(
        "hang in reset", "reset: it has not returned for 3 s.*--env-timeout", "--set", "env_timeout=3"
    ),
    "hang in step": does(
        "hang in step", "step 0: it has not returned for 3 s.*--env-timeout", "--set", "env_timeout=3"
    ),
    "memory": does(
        "grow", r"\d MiB of memory, and 512 MiB are the limit.*--env-memory", "--set", "env_memory=512"
    ),
    "threads": does("threads", PLAYED, code=0),
    "own files": does("write a file", PLAYED, code=0),
    "other files": does(
        "read a file", "step 0: it raised FileNotFoundError.*levels.dat is not shown.*declare it in data"
    ),
    "network": does("connect", f"step 0: it raised OSError: .*{SOURCE}connect: socket"),
    "legacy": does(
        "legacy", r"reset: it returned array\(\[0.\]\).*an observation and a dict, as Gymnasium 1.x has it"
    ),
    "text reward": does("text reward", r"step 0, reward: it is '1.0' \(str\); a reward has to be one number"),
    "rounding": does("rounding", PLAYED, code=0),
    "beyond": does(
        "beyond", r"element \(0,\) is 1.1, not 0.0 to 1.0; .*name a wrapper .* in an environment file"
    ),
    "vector": Row(
        "raised Error: Vectors-v0 registered but entry_point is not specified; correct its gymnasium_id",
        env="odd_envs:Vectors-v0",
    ),
    "shipped name": Row(PLAYED, env="odd_envs:CartPole-v1", code=0),
    "shipped id": Row(
        "ids that begin with gym/ ship with evopolicy",
        env="gym/acrobot",
        file="max_episode_steps = 20",
        code=2,
    ),
    "wrapper": Row(
        f"step 0: it raised LookupError: no such tile.*{SOURCE}step: raise LookupError",
        file='wrappers = [{ wrapper = "odd_envs:Grumbles" }]',
    ),
    "no wrapper": Row("odd_envs:Smiles.*", file='wrappers = [{ wrapper = "odd_envs:Smiles" }]'),
    "kwargs": Row(
        r"raised TypeError: .*'colour'.*correct kwargs \{'colour': 'red'\}",
        file='kwargs = { colour = "red" }',
    ),
    "kwargs that fit": Row(PLAYED, file="kwargs = { size = 2 }", code=0),
    "no package": Row(
        "the package with the module 'their_envs' .*on PYTHONPATH", env="their_envs:X-v0", code=2
    ),
}
"""By name, in the order of how common they are; the first three are played by `make test`."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE))
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "policy.py").write_text(POLICY)
    return tmp_path


def tried(folder: Path, env: str, *options: str) -> tuple[int, str]:
    """Exit code and output of `evopolicy try` with one case."""
    with command(folder, "try", "policy", "--env", env, "--cases", "0", "--fresh", *options) as running:
        code = running.wait()
    return code, " ".join(running.text.split())


@pytest.mark.slow
@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=name, marks=[pytest.mark.system] * (n > 2))
        for n, (name, row) in enumerate(TABLE.items())
    ],
)
def test_an_odd_environment_is_played_or_refused_with_its_sentence(folder: Path, row: Row) -> None:
    env = row.env
    if row.file:
        lines = (f'id = "{env}"', 'gymnasium_id = "odd_envs:Odd-v0"', row.file)
        (folder / "odd.toml").write_text("\n".join(lines))
        env = "odd.toml"
    code, said = tried(folder, env, *row.options)
    assert code == row.code, said
    assert re.search(row.says, said), said
    assert "Traceback" not in said


@pytest.mark.system
@pytest.mark.slow
def test_an_environment_that_is_refused_ends_its_own_run_and_no_other(folder: Path) -> None:
    (folder / "odd.toml").write_text(
        'id = "my/odd"\ngymnasium_id = "odd_envs:Odd-v0"\nkwargs = { does = "crash" }'
    )
    words = ("--env", "odd.toml", "--env", "toy/line", "--agent", "random", "--fresh", *SMALL)
    said = " ".join(
        "".join(ended(folder, "local", *words, "--parallel", "2", "--runs", "runs", ends=1)).split()
    )
    assert re.search(
        rf"my/odd: failed: environment my/odd, step 11: it raised ValueError.*{SOURCE}crash_in_step_12", said
    )
    assert "toy/line: agent ended" in said
    (good,) = folder.glob("runs/random/toy_line/*/run.json")
    assert '"status":"completed"' in good.read_text().replace(" ", "")


@pytest.mark.system
@pytest.mark.slow
def test_python_callers_get_the_refusal_as_an_exception(folder: Path) -> None:
    code = """
import evopolicy as evp
for call in (
    lambda: evp.evaluate("policy", env="broken_import:X-v0", cases=[0], progress=False),
    lambda: evp.run(env="broken_import:X-v0", agent="random", budget=4, progress=False),
):
    try:
        call()
    except evp.EvopolicyError as error:
        print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True, timeout=170
    )
    assert done.stdout.count("No module named 'no_such_dependency'") == 2


@pytest.mark.slow
@pytest.mark.system
def test_check_env_refuses_a_text_as_a_reward(folder: Path) -> None:
    lines = 'id = "my/odd"\ngymnasium_id = "odd_envs:Odd-v0"\nkwargs = { does = "text reward" }'
    (folder / "odd.toml").write_text(lines)
    program = [sys.executable, "-m", "evopolicy_worker.cli", "check-env", "odd.toml"]
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False, timeout=170)
    assert done.returncode == 1
    assert "reward: it is '1.0' (str); a reward has to be one number" in done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_a_package_that_is_only_a_checkout_is_played(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkout = folder / "checkout"
    (checkout / ".git").mkdir(parents=True)
    (checkout / "pyproject.toml").write_text('[project]\nname = "their-envs"\nversion = "0"\n')
    package = checkout / "src" / "their_envs"
    package.mkdir(parents=True)
    text = (PACKAGE / "odd_envs.py").read_text()
    (package / "__init__.py").write_text(text)
    code, said = tried(folder, "their_envs:Odd-v0")
    assert (code, "on PYTHONPATH" in said) == (2, True), said
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    code, said = tried(folder, "their_envs:Odd-v0")
    assert (code, PLAYED in said) == (0, True), said
    if not shutil.which("bwrap"):
        return
    # Environments run as a user of their own where the worker runs as root, and otherwise as that of the worker.
    package.chmod(0)
    code, said = tried(folder, "their_envs:Odd-v0")
    package.chmod(0o755)
    assert code in (1, 2)
    assert f"chmod -R a+rX {package}" in said or "on PYTHONPATH" in said


@pytest.mark.slow
@pytest.mark.system
def test_an_entry_point_offers_a_packages_environments(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = folder / "site"
    info = site / "their_envs-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-envs\nVersion: 1.0\n")
    package = site / "their_envs"
    package.mkdir()
    (package / "__init__.py").write_text((PACKAGE / "odd_envs.py").read_text())
    (package / "envs.toml").write_text('id = "their/odd"\ngymnasium_id = "their_envs:Odd-v0"\n')
    monkeypatch.setenv("PYTHONPATH", str(site))
    for named, expected in (
        ("their_envs:envs.toml", (0, PLAYED)),
        ("their_envs:gone.toml", (2, "names no environment file")),
    ):
        (info / "entry_points.txt").write_text(f"[evopolicy.environments]\nodd = {named}\n")
        code, said = tried(folder, "their/odd")
        assert (code, expected[1] in said) == (expected[0], True), said
