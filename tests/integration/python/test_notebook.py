"""The package in a real Jupyter kernel: the tutorial's notebook, what it displays, and an interrupt."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from queue import Empty
from typing import Any

import nbformat
import pytest
from jupyter_client.manager import start_new_kernel
from nbclient import NotebookClient
from waiting import wait_until

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]

NOTEBOOK = Path(__file__).parents[3] / "examples" / "notebooks" / "tutorial.ipynb"
ENDLESS = """
import time
import evopolicy as evp

def agent(workspace):
    workspace.submit([0])
    time.sleep(600)

evp.run(env="toy/line", agent=agent, budget=4, validation=1, heldout=1, exp_id="stopped")
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The kernel's working folder, and that of all settings that it could read."""
    for name in (
        "JUPYTER_DATA_DIR",
        "JUPYTER_CONFIG_DIR",
        "JUPYTER_RUNTIME_DIR",
        "IPYTHONDIR",
        "XDG_STATE_HOME",
    ):
        monkeypatch.setenv(name, str(tmp_path / name))
    # Else the kernel's debugger warns of modules that Python has frozen.
    monkeypatch.setenv("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    return tmp_path


def test_the_tutorial_shows_progress_plots_and_a_replay(folder: Path) -> None:
    book = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert not [output for cell in code for output in cell.outputs]
    client = NotebookClient(
        book,
        timeout=500,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute()
    shown = [
        "".join("".join(one.get("data", {}).get("text/html", "")) for one in cell.outputs) for cell in code
    ]
    texts = ["".join(str(one.get("data", {}).get("text/plain", "")) for one in cell.outputs) for cell in code]
    assert [index for index, text in enumerate(shown) if "<svg" in text] == [1, 3]
    assert "<video controls" in shown[3]
    assert re.match(r"\(\(\d+, 2\), ", texts[2])
    # Bars disappear at the end of their cells.
    assert "OutputModel" in {state.get("_model_name") for state in client.widget_state.values()}
    assert (
        json.loads((folder / "runs/climb/gym_continuouscar/notebook/run.json").read_text())["outcome"][
            "status"
        ]
        == "completed"
    )


@pytest.fixture
def kernel(folder: Path) -> Iterator[tuple[Any, Any]]:
    manager, client = start_new_kernel(cwd=str(folder), env=dict(os.environ))
    try:
        yield manager, client
    finally:
        client.stop_channels()
        manager.shutdown_kernel()


def reply_to(client: Any, request: str) -> dict[str, Any]:
    def found() -> dict[str, Any] | None:
        try:
            message = client.get_shell_msg(timeout=1)
        except Empty:
            return None
        return dict(message["content"]) if message["parent_header"].get("msg_id") == request else None

    reply = wait_until(found)
    assert reply is not None
    return reply


def test_an_interrupt_cancels_the_run_and_the_kernel_goes_on(folder: Path, kernel: tuple[Any, Any]) -> None:
    manager, client = kernel
    request = client.execute(ENDLESS, stop_on_error=False)  # what is asked next is not dropped
    run = folder / "runs/agent/toy_line/stopped"
    wait_until(lambda: (run / "workspace/feedback/submit_000/summary.json").is_file())
    manager.interrupt_kernel()
    answer = reply_to(client, request)
    assert (answer["status"], answer["ename"]) == ("error", "KeyboardInterrupt")
    assert json.loads((run / "run.json").read_text())["outcome"]["status"] == "cancelled"
    assert reply_to(client, client.execute("import threading"))["status"] == "ok"
