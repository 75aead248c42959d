"""Installed from a wheel, without a clone: everything that messages and pages name is there, and a run is played.

Third-party packages are those of the environment that runs the tests: its site-packages stand behind the clean ones.
Its editable evopolicy is not seen there, since nested .pth files are not read.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import site
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from email.parser import HeaderParser
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from pathlib import Path
from typing import NamedTuple

import pytest
from commands import toy_cluster
from ordinary_user import ordinary, own_all
from packaging.requirements import Requirement
from stages.cli_stage import FAKES
from stages.model_api import ModelApi, Step

from evopolicy_common.records.run_record import decode_run_record

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[3]
NAMED = re.compile(r"\b(?:(?:examples|deploy|docs)/[\w.@/-]*\w|constraints\.txt|\w[\w-]*\.toml)")
REPOSITORY_ONLY = (
    *("docs/images", "docs/_site", "docs/index.md", "examples/smoke-report"),
    "examples/measure_policies.py",
)
"""What pages show or tell developers, and no user needs as a file."""


class Built(NamedTuple):
    wheel: Path
    sdist: Path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return build(ROOT, tmp_path_factory.mktemp("dist"))


def build(source: Path, target: Path) -> Built:
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(target)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Built(next(target.glob("*.whl")), next(target.glob("*.tar.gz")))


def names(wheel: Path) -> list[str]:
    return sorted(zipfile.ZipFile(wheel).namelist())


def test_a_wheel_made_from_the_sdist_is_the_same(built: Built, tmp_path: Path) -> None:
    with tarfile.open(built.sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    again = build(source, tmp_path / "dist")
    assert names(again.wheel) == names(built.wheel)


def test_the_wheel_holds_what_messages_and_pages_name(built: Built) -> None:
    held = names(built.wheel)
    texts = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), ROOT / "deploy" / "README.md"]
    texts += [
        path
        for room in ("common", "coordinator", "worker", "agent_gateway")
        for path in (ROOT / room).rglob("*.py")
    ]
    named = {name for path in texts for name in NAMED.findall(path.read_text()) if (ROOT / name).exists()}
    assert {"constraints.txt", "examples/policies", "examples/agents/qwen.toml"} <= named
    for name in sorted(named):
        if name in ("pyproject.toml",) or name.startswith(REPOSITORY_ONLY):
            continue
        inside = f"evopolicy_gateway/{name}"
        assert any(each == inside or each.startswith(f"{inside}/") for each in held), name
    assert {f"evopolicy_gateway/suite/shipped/{name}.toml" for name in ("smoke", "core16")} <= set(held)
    assert not [name for name in held if "tests/" in name or "__pycache__" in name]


def test_the_extra_local_asks_for_what_this_environment_has(built: Built) -> None:
    with zipfile.ZipFile(built.wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        headers = HeaderParser().parsestr(archive.read(metadata).decode())
    asked = [Requirement(text) for text in headers.get_all("Requires-Dist", [])]

    def of(extra: str) -> dict[str, Requirement]:
        return {str(one): one for one in asked if one.marker is None or one.marker.evaluate({"extra": extra})}

    names = {
        extra: {one.name for one in of(extra).values()}
        for extra in ("local", "coordinator", "gateway", "worker")
    }
    assert names["local"] == names["coordinator"] | names["gateway"] | names["worker"]
    for one in (*of("local").values(), *of("llm").values(), *of("acp").values()):
        try:
            assert one.specifier.contains(version(one.name)), one
        except PackageNotFoundError:
            pytest.fail(f"{one} is asked for, and is not installed here")


class Place:
    """A clean virtual environment and a home, of an ordinary user where the tests run as root."""

    def __init__(self, root: Path, wheel: Path) -> None:
        self.root = root
        self.bin = root / "venv" / "bin"
        self.python, self.prefix = ordinary()
        own_all(root, self.prefix)
        shutil.copy(wheel, root)
        (root / wheel.name).chmod(0o644)
        self.run([self.python, "-m", "venv", "--without-pip", str(root / "venv")])
        (packages,) = (root / "venv" / "lib").glob("python3*/site-packages")
        (packages / "third_party.pth").write_text("\n".join(site.getsitepackages()) + "\n")
        install = ["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--ignore-installed"]
        self.run([str(self.bin / "python"), *install, str(root / wheel.name)])

    def run(self, words: list[str], *, code: int = 0) -> str:
        """Its stdout."""
        done = subprocess.run(
            [*self.prefix, *words],
            cwd=self.root,
            env={"PATH": f"{self.bin}:{os.environ['PATH']}", "HOME": str(self.root), "LANG": "C.UTF-8"},
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        assert done.returncode == code, f"{words}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        return done.stdout


@pytest.fixture(scope="module")
def place(built: Built) -> Iterator[Place]:
    # Not below pytest's own folder, which is closed to other users.
    with tempfile.TemporaryDirectory(prefix="evp-wheel-") as name:
        yield Place(Path(name), built.wheel)


def test_the_installation_finds_its_own_files_and_not_the_repository(place: Place) -> None:
    where = "import evopolicy_common, evopolicy_gateway as g; print(g.__file__, evopolicy_common.__file__)"
    assert str(ROOT) not in place.run([str(place.bin / "python"), "-c", where])
    public = "import evopolicy as evp; print(evp.__file__, evp.evaluate.__doc__)"
    assert str(place.root) in place.run([str(place.bin / "python"), "-c", public])
    assert place.run(["evopolicy", "--version"]).startswith("evopolicy ")
    listed = place.run(["evopolicy", "files"]).splitlines()
    assert {"constraints.txt", "deploy/README.md", "examples/agents/qwen.toml"} <= set(listed)
    constraints = place.run(["evopolicy", "files", "constraints.txt"]).strip()
    assert constraints.startswith(str(place.root))
    assert "mujoco==" in Path(constraints).read_text()
    place.run(["evopolicy", "files", "deploy", "--to", "copied"])
    assert (place.root / "copied" / "deploy" / "evopolicy-worker@.service").is_file()
    place.run(["evopolicy", "files", "deploy", "--to", "copied"], code=2)
    place.run(["evopolicy", "files", "none"], code=2)


def test_doctor_says_that_this_machine_plays_runs(place: Place) -> None:
    document = json.loads(place.run(["evopolicy", "doctor", "--json"]))
    assert document["plays"]
    assert document["tier"] == "bwrap"
    found = {check["name"]: check for check in document["checks"]}
    for name in (
        *("Python", "extra gateway", "drawing (EGL)", "browser", "disk", "ports", "date", "open files"),
    ):
        assert name in found
    for check in document["checks"]:
        assert check["verdict"] != "missing" or (check["advice"] and check["found"]), check


def test_commands_complete_and_the_agents_of_the_extras_start(place: Place) -> None:
    # The rest of the line, as the shell asks for it.
    asked = ["env", "_EVOPOLICY_COMPLETE=complete_bash", "COMP_WORDS=evopolicy do", "COMP_CWORD=1"]
    assert place.run([*asked, "evopolicy"]).split() == ["doctor"]
    for program in ("evopolicy-coordinator", "evopolicy-worker"):
        assert (
            place.run([program, "--version"]).split()[-1] == place.run(["evopolicy", "--version"]).split()[-1]
        )
    output = place.run([str(place.bin / "python"), "-P", "-m", "evopolicy_gateway.agents.llm", "--version"])
    assert output.startswith("pydantic-ai ")
    agent = (
        "from pathlib import Path; from evopolicy_gateway.harnesses import make;"
        " print(make('acp:gemini --acp', Path.cwd()).name, make('llm:openai/m', Path.cwd()).name)"
    )
    start = ["env", "OPENAI_API_KEY=none", str(place.bin / "python"), "-c", agent]
    assert place.run(start).split() == ["acp", "llm"]


class ExtraAlone:
    """A virtual environment with the wheel, what one extra of it requires, and nothing else."""

    def __init__(self, root: Path, wheel: Path, extra: str) -> None:
        self.root = root
        self.bin = root / "venv" / "bin"
        python = os.path.realpath(sys.executable)
        subprocess.run([python, "-m", "venv", "--without-pip", str(root / "venv")], check=True)
        (packages,) = (root / "venv" / "lib").glob("python3*/site-packages")
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(packages)
        (metadata,) = packages.glob("evopolicy-*.dist-info")
        own = HeaderParser().parsestr((metadata / "METADATA").read_text()).get_all("Requires-Dist", [])
        self.installed = {"evopolicy"}
        for name in _required(own, extra, own):
            self.installed.add(name)
            for file in distribution(name).files or ():
                source, target = Path(str(file.locate())), packages / file
                if ".." not in file.parts and source.suffix not in (".pyc", ".pth"):
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(source, target)

    def run(self, *words: str, code: int = 0, **environment: str) -> str:
        """Its stdout and stderr."""
        main = "import sys; from evopolicy_gateway.cli.main import main; sys.argv[0] = 'evopolicy'; main()"
        done = subprocess.run(
            [str(self.bin / "python"), "-P", "-c", main, *words],
            cwd=self.root,
            env={"PATH": f"{self.bin}:/usr/bin:/bin", "HOME": str(self.root), "LANG": "C.UTF-8"}
            | environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        text = done.stdout + done.stderr
        assert done.returncode == code, f"{words}\n{text[-4000:]}"
        return text


def _required(texts: list[str], extra: str, own: list[str]) -> set[str]:
    """Names of the distributions that the requirements of an extra come to, through all of theirs."""
    found: set[str] = set()
    asked = [(requirement, extra) for requirement in map(Requirement, texts)]
    seen: set[tuple[str, str]] = set()
    while asked:
        one, given = asked.pop()
        if one.marker is not None and not one.marker.evaluate({"extra": given}):
            continue
        for its in one.extras or {""}:
            if (one.name, its) in seen:
                continue
            seen.add((one.name, its))
            if one.name != "evopolicy":
                found.add(one.name)
            further = own if one.name == "evopolicy" else requires(one.name) or []
            asked += [(requirement, its) for requirement in map(Requirement, further)]
    return found


KEY = "sk-stub-0123456789abcdef"
SUBMIT = (
    "echo '# better' >> system/policy.py; curl -s --noproxy '*' -X POST"
    " -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL"
)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("extra", ["llm", "acp"])
def test_an_agent_plays_where_its_extra_alone_is_installed(built: Built, tmp_path: Path, extra: str) -> None:
    """On a cluster elsewhere; what needs another extra names it."""
    place = ExtraAlone(tmp_path, built.wheel, extra)
    assert {"starlette", "numpy"} < place.installed
    assert not place.installed & {"jinja2", "gymnasium", "matplotlib"}
    size = ("--env", "toy/line", "--budget", "2", "--validation", "1", "--heldout", "1", "--exp-id", "t")
    (tmp_path / "c").mkdir()
    with toy_cluster(tmp_path / "c") as operator, ModelApi([Step(command=SUBMIT)]) as api:
        api_table = f'base_url = "{api.base_url}/v1"\nkey = "API_KEY"\n'
        (tmp_path / "llm.toml").write_text(f'harness = "llm"\nmodel = "m"\n[api]\n{api_table}')
        agents = {"llm": "file:llm.toml", "acp": f"acp:{FAKES}/acp-agent"}
        given = {"API_KEY": KEY, "FAKE_SCENARIO": "work", "FAKE_STATE": "fake"}
        shown = ("--jail-env", "FAKE_SCENARIO", "--jail-env", "FAKE_STATE") if extra == "acp" else ()
        played = ("run", *size, "--credentials", str(operator))
        place.run(*played, "--agent", agents.pop(extra), *shown, **given)
        ((other, agent),) = agents.items()
        told = place.run(*played, "--agent", agent, "--overwrite", code=2, **given)
        assert f"'evopolicy[{other}] @ file://" in told
    (run,) = (tmp_path / "runs").glob("*/toy_line/t")
    record = decode_run_record((run / "run.json").read_bytes())
    assert (record.outcome.status, record.outcome.budget_used) == ("completed", 2)
    assert "'evopolicy[local] @ file://" in place.run("demo", code=2)
    assert "'evopolicy[coordinator] @ file://" in place.run("report", str(run), "--out", "x", code=2)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_ordinary_user_plays_the_demo(place: Place) -> None:
    output = place.run(["evopolicy", "demo"])
    assert "next: evopolicy report runs --out report" in output
    record = json.loads((place.root / "runs/evolve/gym_continuouscar/demo/run.json").read_text())
    assert record["outcome"]["status"] == "completed"
    assert record["outcome"]["budget_used"] == 32
