"""deploy/kubernetes against Kubernetes' own schemas, and against our commands. No cluster is started."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from documents import APPS, parse
from installed import python_with

pytestmark = pytest.mark.system

DEPLOY = Path(__file__).parents[3] / "deploy"
FILES = sorted((DEPLOY / "kubernetes").glob("*.yaml"))
VERSIONS = ("1.34", "1.37")
"""The oldest and the newest that are tried."""


def pods() -> dict[str, dict[str, Any]]:
    """The pods' specifications by the name of what makes them."""
    documents = [each for path in FILES for each in yaml.safe_load_all(path.read_text())]
    return {
        each["metadata"]["name"]: each["spec"]["template"]["spec"]
        for each in documents
        if "template" in each["spec"]
    }


@pytest.fixture(scope="module")
def validate() -> Path:
    return python_with("kubernetes", "kubernetes-validate==1.37.0").with_name("kubernetes-validate")


@pytest.mark.timeout(600)
@pytest.mark.parametrize("version", VERSIONS)
def test_kubernetes_own_schemas_accept_the_manifests_and_nothing_else(
    validate: Path, version: str, tmp_path: Path
) -> None:
    def status(*paths: Path) -> int:
        command = [validate, "--strict", "--kubernetes-version", version, *paths]
        return subprocess.run(command, capture_output=True, check=False).returncode

    assert len(FILES) == 3
    assert status(*FILES) == 0
    for path in FILES:
        wrong = tmp_path / path.name
        wrong.write_text(path.read_text().replace("runAsUser:", "runAsUsr:"))
        assert status(wrong) != 0


def test_pods_start_with_options_that_our_commands_take() -> None:
    for pod in pods().values():
        (container,) = pod["containers"]
        assert container["command"][0] in APPS
        parse([*container["command"], *container.get("args", [])])
        grace = [*container["command"], "--grace", "0"]
        seconds = float(grace[grace.index("--grace") + 1])
        assert seconds < pod.get("terminationGracePeriodSeconds", 30)
        for each in (*pod["initContainers"], container):
            command = " ".join(each["command"])
            if "evopolicy-coordinator certs" in command:
                parse(command[command.index("evopolicy-coordinator certs") :].partition(";")[0].split())


def test_only_the_pod_with_a_sandbox_inside_is_let_out_of_filters() -> None:
    outside = {"procMount", "seccompProfile", "appArmorProfile"}
    for name, pod in pods().items():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["automountServiceAccountToken"] is False
        mounted = {volume["name"] for volume in pod["volumes"]} | {"volume"}
        for each in (*pod["initContainers"], *pod["containers"]):
            context = each["securityContext"]
            assert context["capabilities"] == {"drop": ["ALL"]}
            assert context["readOnlyRootFilesystem"] is True
            assert context["allowPrivilegeEscalation"] is False
            assert context.keys() & outside == (outside if each["name"] == "worker" else set())
            assert {mount["name"] for mount in each["volumeMounts"]} <= mounted
        assert (pod.get("hostUsers") is False) == (name == "workers")


@pytest.mark.parametrize("name", ["evopolicy-coordinator", "evopolicy-coordinators"])
def test_a_restart_leaves_the_state_folder_private(name: str) -> None:
    """By default, a pod's start gives its group all files of a volume, and a state folder must be its owner's alone."""
    security = pods()[name]["securityContext"]
    assert security["fsGroup"] == security["runAsGroup"]
    assert security["fsGroupChangePolicy"] == "OnRootMismatch"


def test_the_copy_of_a_secret_is_a_folder_that_a_worker_accepts(tmp_path: Path) -> None:
    """A Secret's files are links, which its group may read."""
    secret, own = tmp_path / "secret", tmp_path / "own"
    data = secret / "..2026_11_23"
    data.mkdir(parents=True)
    own.mkdir()
    (data / "worker.json").write_text("{}")
    (data / "worker.json").chmod(0o640)
    (secret / "..data").symlink_to(data.name)
    (secret / "worker.json").symlink_to("..data/worker.json")
    (init,) = pods()["workers"]["initContainers"]
    script = init["command"][2].replace("/secret", str(secret)).replace("/own", str(own))
    subprocess.run(["sh", "-c", script], check=True)
    (kept,) = (own / "keys").iterdir()
    assert (kept.name, kept.is_symlink(), kept.stat().st_mode & 0o777) == ("worker.json", False, 0o600)
