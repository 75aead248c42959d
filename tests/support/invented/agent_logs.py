"""Logs of an agent that made given versions, in the form of each kind of CLI."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from invented.policies import Version


def claude_log(versions: Sequence[Version]) -> list[dict[str, Any]]:
    """A stream of the `stream-json` kind: assistant messages with text and tool calls, tool results as user
    messages."""
    lines: list[dict[str, Any]] = [{"type": "system", "subtype": "init", "model": "test"}]
    for index, version in enumerate(versions):
        content: list[dict[str, Any]] = []
        if index:
            read = f"/workspace/feedback/submit_{index - 1:03d}/summary.json"
            content.append(_tool(f"r{index}", "Read", file_path=read))
        if version.says:
            content.append({"type": "text", "text": version.says})
        content.append(_tool(f"e{index}", "Edit", file_path="/workspace/system/policy.py"))
        for name in version.images:
            content.append(_tool(f"p{index}", "Bash", command=f"python plot.py --out system/{name}"))
        submit = 'curl -s -X POST "$EVOPOLICYGYM_SUBMIT_URL" -d \'{"env_instances": "0-3"}\''
        content.append(_tool(f"s{index}", "Bash", command=submit))
        lines.append({"type": "assistant", "message": {"role": "assistant", "content": content}})
        known = {"submit_id": f"submit_{index:03d}", "status": version.status}
        reply = json.dumps(known | {"summary": {"submit_index": index}})
        result = [{"type": "tool_result", "tool_use_id": f"s{index}", "content": reply}]
        lines.append({"type": "user", "message": {"role": "user", "content": result}})
    lines.append({"type": "result", "subtype": "success", "result": "done"})
    return lines


def _tool(identity: str, name: str, **given: str) -> dict[str, Any]:
    return {"type": "tool_use", "id": identity, "name": name, "input": given}


def codex_log(versions: Sequence[Version]) -> list[dict[str, Any]]:
    """A stream of the `exec --json` kind: completed items."""
    lines: list[dict[str, Any]] = [{"type": "thread.started", "thread_id": "t"}]
    for index, version in enumerate(versions):
        if index:
            folder = f"feedback/submit_{index - 1:03d}"
            command = f"cat {folder}/summary.json && head {folder}/episodes/ep_000/trajectory.jsonl"
            lines.append(_item({"type": "command_execution", "command": command, "aggregated_output": "{}"}))
        if version.says:
            lines.append(_item({"type": "agent_message", "text": version.says}))
        changes = [{"path": "system/policy.py", "kind": "update"}]
        lines.append(_item({"type": "file_change", "changes": changes}))
        reply = json.dumps({"submit_id": index, "status": version.status})
        submit = "curl -X POST $EVOPOLICYGYM_SUBMIT_URL -d @request.json"
        lines.append(_item({"type": "command_execution", "command": submit, "aggregated_output": reply}))
    return lines


def _item(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "item.completed", "item": item}


def turn_log(versions: Sequence[Version]) -> list[dict[str, Any]]:
    """The turn protocol of command agents."""
    lines: list[dict[str, Any]] = []
    for index, version in enumerate(versions):
        lines.append({"type": "prompt", "turn": index, "message": "Go on."})
        text = version.says or f"submit {index}"
        lines.append({"turn": index, "text": text, "stop": index + 1 == len(versions)})
    return lines


LOGS = {"claude": claude_log, "codex": codex_log, "turns": turn_log}
