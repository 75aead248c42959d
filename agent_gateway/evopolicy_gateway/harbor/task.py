"""The files of a Harbor task for one open run of a remote agent (`run --agent remote`). Pure.

Harbor starts the agent in a container, with the run's workspace as its working directory and the run's bearer token in
its environment. Its verifier runs `tests/test.sh` in a container of its own after the agent's container has been
stopped: the agent has ended then and cannot write the reward.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.run_folder.listener import TOKEN_VARIABLE
from evopolicy_gateway.workspace.prompts import FIRST

WORKDIR = "/work"
"""The workspace in the container."""
VERIFIER_S = 24 * 3600.0
"""Time for the hidden episodes of a run after its agent's end."""
_ODD = re.compile(r"[^A-Za-z0-9._-]+")

_INSTRUCTION = f"""\
Your working directory is `{WORKDIR}`. {FIRST}
"""
_DOCKERFILE = f"""\
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates curl git && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir numpy
WORKDIR {WORKDIR}
"""
_TEST = """\
#!/bin/sh
# Ends the run, and waits for its score, which is the reward.
while :; do
    status=$(curl -sS -m 60 -X POST -H 'Authorization: Bearer {token}' -o /tmp/score -w '%{{http_code}}' '{url}')
    case "$status" in
        200) mkdir -p /logs/verifier && cp /tmp/score /logs/verifier/reward.txt && exit ;;
        # A busy service answers 503, and other agents can reach it: their requests must not cost this run its reward.
        202 | 000 | 502 | 503 | 504) sleep 2 ;;
        *) cat /tmp/score >&2; exit 1 ;;
    esac
done
"""


def task_name(folder: RunFolder) -> str:
    """The name of a run's task, from the path of its folder."""
    root = folder.root
    words = (root.parent.parent.name, root.parent.name, root.name)
    return "-".join(filter(None, (_ODD.sub("-", word).strip("-._") for word in words))).lower()


def _toml(text: str) -> str:
    """As a TOML string, which differs from JSON's: it has no surrogates, and DEL is escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def task_files(folder: RunFolder, *, env: str, url: str, token: str, agent_s: float) -> Mapping[str, str]:
    """The task's files by path. `url`, `token`: where its verifier gets the score; `agent_s`: the agent's time,
    seconds."""
    name = task_name(folder)
    volumes = [
        {
            "type": "bind",
            # A `$` begins a variable in such a file.
            "source": f"{folder.workspace}{part}".replace("$", "$$"),
            "target": f"{WORKDIR}{part}",
            "read_only": part != "",
        }
        for part in ("", "/feedback", "/AGENTS.md")
    ]
    bearer = folder.bearer.read_text().strip()
    # With such a file, Harbor's Docker passes `env` of task.toml to Compose and not to the container.
    service = {"volumes": volumes, "environment": {TOKEN_VARIABLE: bearer}}
    task = f"""\
schema_version = "1.4"

[task]
name = "evopolicy/{name}"
description = {_toml(f"Improve a policy for {env}; the reward is its mean return on hidden cases.")}

[metadata]
env = {_toml(env)}
run = {_toml(str(folder.root))}

[environment]
env = {{ {TOKEN_VARIABLE} = "{bearer}" }}

[agent]
timeout_sec = {agent_s}

[verifier]
environment_mode = "separate"
timeout_sec = {VERIFIER_S}
"""
    return {
        "task.toml": task,
        "instruction.md": _INSTRUCTION,
        "environment/Dockerfile": _DOCKERFILE,
        # JSON is YAML.
        "environment/docker-compose.yaml": json.dumps({"services": {"main": service}}, indent=2) + "\n",
        "tests/test.sh": _TEST.format(url=url, token=token),
    }
