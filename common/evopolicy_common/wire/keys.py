"""Zenoh key expressions, all under `evopolicy/v1/<cluster>/`. Access control grants rights by these prefixes."""

from __future__ import annotations

import re

from evopolicy_common.wire.credentials import Role

_ROOT = "evopolicy/v1"
_PLACES: dict[Role, str] = {"worker": "work", "gateway": "gw", "operator": "ops"}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


def valid_name(name: str) -> bool:
    """Whether `name` is valid in a key: the name of a cluster, worker or run."""
    return _NAME.fullmatch(name) is not None


def worker_key(cluster: str, verb: str) -> str:
    """Key of a worker's requests: `register`, `lease`, `beat`, `done`, `blob`."""
    return f"{_ROOT}/{cluster}/work/{verb}"


def liveliness_key(cluster: str, worker: str) -> str:
    """Key of a worker's liveliness token: a hint to check its leases now, never a fact. `*`: of all workers."""
    return f"{_ROOT}/{cluster}/worker/{worker}/live"


def gateway_key(cluster: str, run: str, verb: str) -> str:
    """Key of requests of the gateway of `run`: `open`, `permit`, `state`, `submit`, `results`, `close`, `blob`."""
    return f"{_ROOT}/{cluster}/gw/{run}/{verb}"


def operator_key(cluster: str, verb: str) -> str:
    return f"{_ROOT}/{cluster}/ops/{verb}"


def requests(cluster: str) -> dict[Role, str]:
    return {role: f"{_ROOT}/{cluster}/{place}/**" for role, place in _PLACES.items()}
