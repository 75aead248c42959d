"""Zenoh key expressions, all under `evopolicy/v1/<cluster>/`. Access control grants by these prefixes."""

from __future__ import annotations

import re

_ROOT = "evopolicy/v1"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


def valid_name(name: str) -> bool:
    """Whether `name` may stand in a key: a cluster's, worker's or run's name."""
    return _NAME.fullmatch(name) is not None


def worker_key(cluster: str, verb: str) -> str:
    """Where workers ask: `register`, `lease`, `beat`, `done`, `blob`."""
    return f"{_ROOT}/{cluster}/work/{verb}"


def liveliness_key(cluster: str, worker: str) -> str:
    """A worker's liveliness token: a hint to look at its leases now, never the truth."""
    return f"{_ROOT}/{cluster}/worker/{worker}/live"


def gateway_key(cluster: str, run: str, verb: str) -> str:
    """Where the gateway of `run` asks: `open`, `state`, `submit`, `results`, `close`, `blob`."""
    return f"{_ROOT}/{cluster}/gw/{run}/{verb}"


def operator_key(cluster: str, verb: str) -> str:
    """Where operators ask."""
    return f"{_ROOT}/{cluster}/ops/{verb}"


def worker_expr(cluster: str) -> str:
    """All that workers ask."""
    return f"{_ROOT}/{cluster}/work/**"


def gateway_expr(cluster: str) -> str:
    """All that gateways of all runs ask."""
    return f"{_ROOT}/{cluster}/gw/**"


def operator_expr(cluster: str) -> str:
    """All that operators ask."""
    return f"{_ROOT}/{cluster}/ops/**"


def liveliness_expr(cluster: str) -> str:
    """All workers' liveliness tokens."""
    return f"{_ROOT}/{cluster}/worker/*/live"
