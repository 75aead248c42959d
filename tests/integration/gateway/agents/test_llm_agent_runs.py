"""Whole runs of the built-in LLM agent in its jail, against a model API on loopback."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import command, record_in, run_dir
from stages.model_api import CACHED, INPUT, OUTPUT, ModelApi, Step

pytestmark = pytest.mark.system

SUBMIT = "echo '# better' >> system/policy.py; curl -s -X POST -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL"  # noqa: E501
PROBE = (
    "cat /proc/[0-9]*/environ /proc/[0-9]*/cmdline | tr '\\0' '\\n'; cat /proc/$PPID/mem; curl -sS -m 5"
    " https://example.org; curl -sS -m 5 $SIDE; python3 -c 'import gymnasium'; true"
)
KEY = "key-of-the-test-0123456789"


@pytest.mark.parametrize("protocol", ["openai", "anthropic"])
def test_a_model_with_a_shell_plays_a_whole_run_in_its_jail(
    tmp_path: Path, protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODEL_ACCESS", KEY)
    script = [
        Step(command=PROBE),
        Step(command=SUBMIT),
        Step(text="a first try"),
        Step(command=SUBMIT),
        Step(text="done"),
    ]
    with ModelApi(script) as api, ModelApi([]) as side:
        base = f"{api.base_url}/v1" if protocol == "openai" else api.base_url
        (tmp_path / "agent.toml").write_text(f"""
harness = "llm"
model = "m-1"
prices = {{ input = 1.0, output = 10.0 }}
environment = {{ SIDE = "{side.base_url}" }}
[api]
protocol = "{protocol}"
base_url = "{base}"
key = "MODEL_ACCESS"
""")
        arguments = ("--env", "toy/line", "--agent", "file:agent.toml", "--exp-id", "t", "--budget", "4")
        small = ("--validation", "1", "--heldout", "1", "--slots", "1")
        with command(tmp_path, "local", *arguments, *small) as running:
            assert running.wait() == 0, running.text
    folder = run_dir(tmp_path)
    record = record_in(folder)
    assert (record.jail, record.outcome.budget_used, record.agent.harness) == ("bwrap", 4, "llm")
    assert record.agent.model_string == "m-1"
    assert record.agent.tokens is not None
    assert record.agent.tokens.input_noncached == 5 * (INPUT - CACHED)
    assert record.agent.tokens.output == 5 * OUTPUT
    assert record.agent.tokens.cost is not None
    assert "api" in record.agent.settings
    log = (folder / "logs/agent.jsonl").read_text()
    assert KEY not in log
    lines = [json.loads(line) for line in log.splitlines()]
    outputs = [line["message"]["content"][0]["content"] for line in lines if line["type"] == "user"]
    # Neither a host of the world, nor another port of this machine, nor a simulator.
    assert "Could not resolve host" in outputs[0] or "403" in outputs[0] or "CONNECT" in outputs[0]
    assert (
        "Connection refused" in outputs[0]
        or "Failed to connect" in outputs[0]
        or "Couldn't connect" in outputs[0]
    )
    assert "No module named 'gymnasium'" in outputs[0]
    assert side.requests == []
    # Neither in the environment of any process of the jail nor in a command line.
    assert "EVOPOLICYGYM_SUBMIT_URL" in outputs[0]
    assert KEY not in str(api.requests)
    assert "mem: Permission denied" in outputs[0]
    policy = folder / "checkpoints" / "submit_001" / "policy.py"
    assert policy.read_text().count("# better") == 2
