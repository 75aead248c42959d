"""Loaded by Harbor's own processes in tests: a stand-in for Docker, and a scripted agent.

The stand-in reads a task's volumes and variables as Docker would, and plays commands in a namespace of bubblewrap,
whose
`/work`, `/logs`, `/tests` and `/tmp` are its own. It builds no image: programs are those of this machine.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import yaml
from harbor.agents.base import BaseAgent
from harbor.environments.base import BaseEnvironment, ExecResult
from harbor.models.environment_type import EnvironmentType

OWN = ("installed-agent", "logs", "solution", "tests", "tmp")
"""Folders of the container's own."""


class Container(BaseEnvironment):
    """One container."""

    stopped = False

    @staticmethod
    def type() -> EnvironmentType:
        return EnvironmentType.DOCKER

    def _validate_definition(self) -> None:
        assert (self.environment_dir / "Dockerfile").exists()

    async def start(self, force_build: bool) -> None:
        self._root = Path(tempfile.mkdtemp(prefix="harbor-box-"))
        for name in (*OWN, "logs/agent", "logs/verifier", "logs/artifacts"):
            (self._root / name).mkdir()

    async def stop(self, delete: bool) -> None:
        shutil.rmtree(self._root, ignore_errors=True)

    def _inside(self, path: str) -> Path:
        assert path.startswith(tuple(f"/{name}" for name in OWN)), path
        return self._root / path.removeprefix("/")

    def _service(self) -> dict[str, Any]:
        compose = yaml.safe_load((self.environment_dir / "docker-compose.yaml").read_text())
        found: dict[str, Any] = compose["services"]["main"]
        return found

    def _binds(self) -> list[str]:
        words: list[str] = []
        for path in sorted(Path("/").iterdir()):
            if path.name not in (*OWN, "work", "dev", "proc"):
                if path.is_symlink():
                    words += ["--symlink", os.readlink(path), str(path)]
                else:
                    words += ["--ro-bind", str(path), str(path)]
        for name in OWN:
            words += ["--bind", str(self._root / name), f"/{name}"]
        for volume in self._service()["volumes"]:
            bind = "--ro-bind" if volume["read_only"] else "--bind"
            words += [bind, volume["source"].replace("$$", "$"), volume["target"]]
        return [*words, "--dev", "/dev", "--proc", "/proc", "--unshare-pid", "--die-with-parent"]

    async def exec(
        self,
        command: str,
        cwd: str | None = None,
        env: dict[str, str] | None = None,
        timeout_sec: int | None = None,
        user: str | int | None = None,
    ) -> ExecResult:
        environment = {"PATH": os.environ["PATH"], "HOME": "/tmp", **self._service()["environment"]}
        environment |= self._merge_env(env) or {}
        process = await asyncio.create_subprocess_exec(
            *("bwrap", *self._binds(), "--chdir", cwd or "/work", "sh", "-c", command),
            env=environment,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, err = await asyncio.wait_for(process.communicate(), timeout_sec)
        return ExecResult(stdout=out.decode(), stderr=err.decode(), return_code=process.returncode or 0)

    async def upload_file(self, source_path: Path | str, target_path: str) -> None:
        target = self._inside(target_path)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source_path, target)

    async def upload_dir(self, source_dir: Path | str, target_dir: str) -> None:
        shutil.copytree(source_dir, self._inside(target_dir), dirs_exist_ok=True)

    async def download_file(self, source_path: str, target_path: Path | str) -> None:
        shutil.copy2(self._inside(source_path), target_path)

    async def download_dir(self, source_dir: str, target_dir: Path | str) -> None:
        shutil.copytree(self._inside(source_dir), target_dir, dirs_exist_ok=True)


class Scripted(BaseAgent):
    """Submits as the run's rules say, until its budget is spent."""

    @staticmethod
    def name() -> str:
        return "scripted"

    def version(self) -> str:
        return "1"

    async def setup(self, environment: BaseEnvironment) -> None:
        pass

    async def run(self, instruction: str, environment: BaseEnvironment, context: Any) -> None:
        assert "/work" in instruction
        submit = "$(grep -m1 -- '-X POST' AGENTS.md)"
        for command in (
            "! touch AGENTS.md && ! touch feedback/x && ! ls /tests/test.sh",
            f'echo "# better" >> system/policy.py && eval "{submit}"',
            f'eval "{submit}"',
        ):
            done = await environment.exec(command)
            (self.logs_dir / "scripted.txt").open("a").write(f"{command}\n{done.stdout}{done.stderr}\n")
            assert done.return_code == 0, done
