"""The files of `deploy/` with PostgreSQL and an object store, played on both: their options and keys are enough."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from cryptography.fernet import Fernet
from machines.postgres import Server
from machines.seaweedfs import ObjectStore

from evopolicy_common.records.blobs import digest_of
from evopolicy_coordinator.storage.engines import DATABASE
from evopolicy_coordinator.storage.objects import ObjectBlobs
from evopolicy_coordinator.storage.store import Store

pytestmark = pytest.mark.cluster

DEPLOY = Path(__file__).parents[3] / "deploy"
TIMEOUT_S = 60.0


@pytest.fixture
def composed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ObjectStore]:
    """SeaweedFS as `compose-postgresql.yaml` starts it, with the keys that README.md makes."""
    readme = (DEPLOY / "README.md").read_text()
    lines = re.findall(r"^(?:secret=|printf ).*$", readme, re.MULTILINE)
    (tmp_path / "machines").mkdir()
    subprocess.run(["sh", "-ec", "\n".join(lines)], cwd=tmp_path, check=True)
    loaded = yaml.safe_load((DEPLOY / "compose-postgresql.yaml").read_text())["services"]
    own = ("-dir=", "-ip=", "-ip.bind=", "-s3.config=")  # of the container: folders and names
    options = [word for word in loaded["objects"]["command"][1:] if not word.startswith(own)]
    found = ObjectStore(tmp_path / "machines" / "s3.json", options)
    environment = dict(line.split("=") for line in (tmp_path / "machines/objects.env").read_text().split())
    environment |= loaded["first"]["environment"] | {"AWS_ENDPOINT_URL": found.keys["AWS_ENDPOINT_URL"]}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    yield found
    found.close()


def test_the_compose_files_object_store_takes_blobs_with_the_readmes_keys(
    tmp_path: Path, composed: ObjectStore
) -> None:
    command = yaml.safe_load((DEPLOY / "compose-postgresql.yaml").read_text())["services"]["first"]["command"]
    (address,) = (word.partition("=")[2] for word in command if word.startswith("--blobs="))
    store = Store(tmp_path / DATABASE)
    store.load()
    blobs = ObjectBlobs(tmp_path / "copies", address, tmp_path / DATABASE)
    blobs.claim("ours")
    blobs.put(b"a bundle")
    blobs.drop_unfinished()
    assert blobs.read_blob(digest_of(b"a bundle")) == b"a bundle"
    blobs.sweep()
    assert blobs.delete(digest_of(b"a bundle")) == len(b"a bundle")
    store.close()


class Pod:
    """One pod of `kubernetes/coordinators.yaml`: its containers' commands, with folders and addresses of this test."""

    def __init__(self, root: Path, words: dict[str, str]) -> None:
        self.root, self._words = root, words
        for name in ("own", "volume"):
            (root / name).mkdir(parents=True)
        documents = yaml.safe_load_all((DEPLOY / "kubernetes" / "coordinators.yaml").read_text())
        (self._spec,) = (each["spec"]["template"]["spec"] for each in documents if "template" in each["spec"])
        self.log = root / "log"

    def start(self) -> subprocess.Popen[bytes]:
        (init,), (main,) = self._spec["initContainers"], self._spec["containers"]
        self._started(init).wait(TIMEOUT_S)
        self.process = self._started(main)
        return self.process

    def said(self, words: str) -> None:
        """Waits for that."""
        deadline = time.monotonic() + TIMEOUT_S
        while words not in self.log.read_text():
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.05)

    def listens(self) -> bool:
        """As the readiness probe sees it."""
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", int(self._words["0.0.0.0:7447"].rpartition(":")[2]))) == 0

    def _started(self, container: dict[str, Any]) -> subprocess.Popen[bytes]:
        named = {each["name"]: self._here(each["value"]) for each in container["env"]}
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        words = [self._here(word) for word in (*container["command"], *container["args"])]
        with self.log.open("ab") as log:
            return subprocess.Popen(
                words,
                env={**os.environ, **named, "PATH": path},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _here(self, word: str) -> str:
        for theirs, ours in self._words.items():
            word = word.replace(theirs, ours)
        return word.replace("/own/", f"{self.root}/own/").replace("/volume/", f"{self.root}/volume/")


def test_both_pods_of_the_kubernetes_file_start_and_take_over(
    tmp_path: Path, server: Server, object_store: ObjectStore
) -> None:
    """The first pod makes the cluster's authority, the second one takes it from the database, and leads when the first
    one is lost. A standby does not listen, so that it is not ready."""
    store = server.new()
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "pgpass").write_text(server.passfile.read_text())
    (secret / "seal-key").write_bytes(Fernet.generate_key())
    pods = []
    for name in ("first", "second"):
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        words = {
            "postgresql://evopolicy@DATABASE/evopolicy": store,
            "s3://BUCKET/evopolicy": object_store.new()
            if not pods
            else pods[0]._words["s3://BUCKET/evopolicy"],
            "https://OBJECTS": object_store.keys["AWS_ENDPOINT_URL"],
            "0.0.0.0:7447": f"127.0.0.1:{port}",
            "/secret/": f"{secret}/",
        }
        pods.append(Pod(tmp_path / name, words))
    first, second = pods
    try:
        first.start()
        deadline = time.monotonic() + TIMEOUT_S
        while not first.listens():
            assert first.process.poll() is None, first.log.read_text()
            assert time.monotonic() < deadline, first.log.read_text()
            time.sleep(0.05)
        second.start()
        second.said("standby: waiting to lead")
        assert not second.listens()
        folders = [pod.root / "volume" / "state" for pod in pods]
        for name in ("certs/ca.pem", "identity.json", "secret"):
            assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
        assert json.loads((folders[0] / "identity.json").read_text())["cluster"]
        first.process.kill()
        while not second.listens():
            assert second.process.poll() is None, second.log.read_text()
            assert time.monotonic() < deadline, second.log.read_text()
            time.sleep(0.05)
    finally:
        for pod in pods:
            if hasattr(pod, "process"):
                pod.process.kill()
                pod.process.wait()
