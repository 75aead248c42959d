"""A PostgreSQL server of the tests' own: an ordinary user's, in a temporary folder, on a free port, with a password."""

from __future__ import annotations

import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import psycopg
import pytest
from program_runs import run_program

_USER = "nobody"
"""As root the server runs as this user: PostgreSQL refuses root."""
_TIMEOUT_S = 60.0


def programs() -> Path | None:
    """The folder of the newest installed server's programs."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[-3]))
    on_path = shutil.which("initdb")
    return found[-1].parent if found else Path(on_path).resolve().parent if on_path else None


class Server:
    """A started server. Its password is in the file that `PGPASSFILE` names."""

    def __init__(self, *, durable: bool = False, follows: Server | None = None, net: str = "") -> None:
        """`durable`: it waits for the disk. `follows`: it has that one's rows by streaming replication, and each commit
        there waits until they can be read here. `net`: it also serves clients of this network, as `10.0.0.0/24`."""
        bin_ = programs()
        if bin_ is None:
            pytest.skip("needs a PostgreSQL server: make test-cluster as root, or apt-get install postgresql")
        self._programs = bin_
        self.root = Path(tempfile.mkdtemp(prefix="evp-pg-"))
        self._owner: dict[str, Any] = (
            {} if os.geteuid() else {"user": _USER, "group": pwd.getpwnam(_USER).pw_gid, "extra_groups": []}
        )
        if not os.geteuid():
            os.chown(self.root, pwd.getpwnam(_USER).pw_uid, -1)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._durable, self._listen = durable, "*" if net else "127.0.0.1"
        self.password = secrets.token_hex(8) if follows is None else follows.password
        password = self.root / "password"
        password.write_text(self.password)
        password.chmod(0o644)
        data = ("-D", str(self.root / "data"), "--no-sync")
        if follows is None:
            how = ("-U", "evopolicy", "-A", "scram-sha-256", f"--pwfile={password}")
            self._run("initdb", *data, *how, "-E", "UTF8", "--locale=C.UTF-8")
            with (self.root / "data" / "pg_hba.conf").open("a") as rules:
                rules.write(f"host all all {net} scram-sha-256\n" if net else "")
        else:
            link = f"host=127.0.0.1 port={follows.port} user=evopolicy password={self.password}"
            self._run("pg_basebackup", *data, "--checkpoint=fast", "--write-recovery-conf", "-d", link)
        self.passfile = self.root.with_name(f"{self.root.name}.pass")
        self.passfile.write_text(f"*:{self.port}:*:evopolicy:{self.password}\n")
        self.passfile.chmod(0o600)
        self._n = 0
        self.start()
        if follows is not None:
            for setting in ("synchronous_standby_names = '*'", "synchronous_commit = remote_apply"):
                follows.query("postgres", f"ALTER SYSTEM SET {setting}")
            follows.query("postgres", "SELECT pg_reload_conf()")
            synchronous = "SELECT 1 FROM pg_stat_replication WHERE sync_state = 'sync'"
            deadline = time.monotonic() + _TIMEOUT_S
            while not follows.query("postgres", synchronous):
                assert time.monotonic() < deadline
                time.sleep(0.05)

    def start(self) -> None:
        """Returns once it answers."""
        fast = () if self._durable else ("-F",)
        with (self.root.with_name(f"{self.root.name}.log")).open("ab") as log:
            self.process = subprocess.Popen(
                [self._programs / "postgres", "-D", self.root / "data", "-p", str(self.port),
                 "-h", self._listen, "-k", self.root, *fast],
                stdout=log, stderr=log, cwd="/", **self._owner,
            )  # fmt: skip
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            try:
                psycopg.connect(self.address("postgres"), passfile=str(self.passfile)).close()
            except psycopg.OperationalError:
                assert self.process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.05)
            else:
                return

    def kill(self) -> None:
        """All its processes at once, as in a power cut."""
        found = run_program("ps", "--ppid", str(self.process.pid), "-o", "pid=")
        for pid in (self.process.pid, *map(int, found.stdout.split())):
            os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """A fast shutdown: it ends all sessions."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(_TIMEOUT_S)

    def close(self) -> None:
        """Ends it and removes its files."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGQUIT)
            self.process.wait(_TIMEOUT_S)
        shutil.rmtree(self.root, ignore_errors=True)
        for suffix in ("pass", "log"):
            self.root.with_name(f"{self.root.name}.{suffix}").unlink()

    def address(self, database: str) -> str:
        return f"postgresql://evopolicy@127.0.0.1:{self.port}/{database}"

    def new(self) -> str:
        """The address of an empty database."""
        self._n += 1
        self.query("postgres", f"CREATE DATABASE test_{self._n}")
        return self.address(f"test_{self._n}")

    def query(self, database: str, statement: str) -> list[tuple[object, ...]]:
        """The rows of a statement of the tests' own."""
        at = database if database.startswith("postgresql:") else self.address(database)
        with psycopg.connect(at, passfile=str(self.passfile), autocommit=True) as db:
            found = db.execute(statement.encode())
            return found.fetchall() if found.description else []

    def _run(self, program: str, *args: str) -> None:
        done = run_program(self._programs / program, *args, cwd="/", **self._owner)
        assert done.returncode == 0, done.stderr
