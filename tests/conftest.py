"""Options of the test run."""

from __future__ import annotations

import signal

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fault-seeds",
        type=int,
        default=0,
        help="tests/faults: instants at which each kind of fault strikes; 0: some kinds only, at one",
    )
    parser.addoption(
        "--rewrite-transcripts",
        action="store_true",
        help="write the core's transcripts (coordinator/evopolicy_coordinator/core/transcripts) anew from what it does now",
    )


def pytest_configure(config: pytest.Config) -> None:
    # A shell ignores Ctrl-C for what it starts in the background, and children inherit that: tests that press it could
    # not be run there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
