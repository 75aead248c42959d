"""Acts from the live view reach a real coordinator and worker, and are written down, refused ones too."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from commands import command, toy_cluster
from waiting import wait_until

from evopolicy_coordinator.web.access import kept_tokens

pytestmark = pytest.mark.system


def test_a_worker_is_paused_and_resumed_and_a_refusal_is_reported(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    tokens, log, address = kept_tokens(tmp_path / "tokens"), tmp_path / "acts.jsonl", tmp_path / "address"
    with toy_cluster(tmp_path) as operator:
        arguments = [
            "web",
            "runs",
            "--credentials",
            str(operator),
            "--http",
            "127.0.0.1:0",
            "--token-file",
            "tokens",
        ]
        arguments += ["--act", "--action-log", str(log), "--url-file", str(address)]
        with command(tmp_path, *arguments) as view:
            wait_until(address.exists, lambda: view.text)
            base = address.read_text().partition("/login")[0]
            wait_until(lambda: f"{base}/login#token={tokens.act}" in view.out, lambda: view.text)
            with httpx.Client(
                base_url=base, headers={"authorization": f"Bearer {tokens.act}"}, timeout=60
            ) as client:

                def listed() -> list[dict[str, str]]:
                    program = [sys.executable, "-m", "evopolicy_gateway.cli", "workers", "list", "--json"]
                    done = subprocess.run(
                        [*program, "--credentials", str(operator)], capture_output=True, check=True
                    )
                    found: list[dict[str, str]] = json.loads(done.stdout)
                    return found

                (worker,) = wait_until(listed)
                wait_until(lambda: worker["worker"] in client.get("/cluster").text)
                place = f"/act/worker/{worker['worker']}"
                assert "It gets no more work" in client.get(f"{place}/pause").text
                assert listed()[0]["state"] == "active", "asking what would happen does nothing"
                assert client.post(f"{place}/pause").status_code == 303
                assert listed()[0]["state"] == "paused"
                assert client.post(f"{place}/resume").status_code == 303
                assert listed()[0]["state"] == "active"
                refused = client.post("/act/run/r-unknown/cancel")
                assert refused.status_code == 409
                assert "Not done" in refused.text
                assert client.post("/act/run/r-1/repin", content="class=x").status_code == 400
                entries = [json.loads(line) for line in log.read_text().splitlines()]
                assert [(one["act"], one["outcome"].partition(":")[0]) for one in entries] == [
                    ("worker pause", "asked"),
                    ("worker pause", "done"),
                    ("worker resume", "asked"),
                    ("worker resume", "done"),
                    ("run cancel", "asked"),
                    ("run cancel", "refused"),
                ]
                assert "evopolicy_workers" in client.get("/metrics").text
                assert tokens.act not in log.read_text()
