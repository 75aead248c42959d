"""A Python function as agent: `python -m evopolicy_gateway.agents.function FILE`, in the workspace, inside the jail.

FILE holds the function, pickled by cloudpickle on the host. It is called with a `Workspace`. Its return value is
written as JSON to `result.json`: the host never unpickles anything written by an agent.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from evopolicy_gateway.agents.client import Client, RefusedSubmit, exit_after

RESULT = "result.json"


class SubmitRefusedError(Exception):
    """A submit was refused and not charged; `status` and the message give the reason."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(f"{status}: {message}")
        self.status = status


class Workspace:
    """The interface for an agent function: the workspace's files, the task, and submits."""

    def __init__(self, client: Client, folder: Path) -> None:
        self._client = client
        self.folder = folder
        """The workspace. `system/` is the policy, `feedback/` holds the results of submits."""
        self.n_submits = 0
        """Number of submits charged so far."""

    @property
    def info(self) -> dict[str, Any]:
        """The present content of the run's `/info`: spaces, environment, bounds, state."""
        return self._client.info()

    @property
    def task(self) -> str:
        """The task's text, Markdown."""
        return self._client.task()

    @property
    def remaining_budget(self) -> int:
        """Episodes left."""
        return int(self.info["state"]["remaining_budget"])

    def write(self, policy: str | Mapping[str, str]) -> None:
        """Writes `system/policy.py`, or several files given by their paths below `system/`."""
        files = {"policy.py": policy} if isinstance(policy, str) else policy
        for name, text in files.items():
            path = self.folder / "system" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")

    def submit(self, cases: Iterable[int]) -> dict[str, Any]:
        """Submits the present `system/` on these train ids, waits, and returns the content of the submit's
        `summary.json`.

        Raises SubmitRefusedError when the submit is refused (the budget is too small, an id is unknown, the run is
        closed).
        """
        verdict = self._client.submit([int(case) for case in cases])
        if isinstance(verdict, RefusedSubmit):
            raise SubmitRefusedError(verdict.status, verdict.message)
        self.n_submits += 1
        return verdict.summary


def _fail(message: str) -> NoReturn:
    print(f"function: {message}", file=sys.stderr)
    raise SystemExit(1)


def main() -> None:
    """Runs the function in the current directory. Exit code 0 when a submit was charged and the return value is
    JSON."""
    import cloudpickle

    # The function knows this module's classes by these names, such as `evopolicy.SubmitRefusedError`.
    for name in ("evopolicy", "evopolicy_gateway.agents.function"):
        sys.modules[name] = sys.modules[__name__]
    try:
        function = cloudpickle.loads(Path(sys.argv[1]).read_bytes())
    except ModuleNotFoundError as error:
        _fail(f"{error}: in the jail there are the standard library, numpy and the function's own code")

    def play_function(client: Client) -> int:
        workspace = Workspace(client, Path.cwd())
        value = function(workspace)
        try:
            text = json.dumps(value)
        except (TypeError, ValueError) as error:
            _fail(
                f"the function's value is not JSON ({error}); return numbers, texts, lists and dicts of them"
            )
        (workspace.folder / RESULT).write_text(text, encoding="utf-8")
        return workspace.n_submits

    exit_after("function", play_function)


if __name__ == "__main__":
    main()
