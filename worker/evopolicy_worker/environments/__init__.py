"""Environments as the worker plays them: one interface, an adapter for Gymnasium, and toys without a simulator."""

from __future__ import annotations

from evopolicy_worker.environments.interface.actions import ActionCodec, compile_actions
from evopolicy_worker.environments.interface.base import Environment, Frame, Observation, Step
from evopolicy_worker.environments.interface.settings import process_environment
from evopolicy_worker.environments.registry import (
    check_played,
    define,
    defined,
    definition,
    describe,
    make,
    measured,
    missing,
    offered,
)

__all__ = [
    "ActionCodec",
    "Environment",
    "Frame",
    "Observation",
    "Step",
    "check_played",
    "compile_actions",
    "define",
    "defined",
    "definition",
    "describe",
    "make",
    "measured",
    "missing",
    "offered",
    "process_environment",
]
