"""A policy's declaration is read from its source and never run."""

from __future__ import annotations

import pytest

from evopolicy_common.records.code_metrics import declares_deterministic


@pytest.mark.parametrize(
    ("source", "declared"),
    [
        ("class Policy:\n    deterministic = True\n", True),
        ("class Policy:\n    deterministic: bool = True\n", True),
        ("class Policy:\n    deterministic = False\n", False),
        ("class Policy:\n    deterministic = 1\n", False),
        ("class Policy:\n    deterministic = not False\n", False),
        ("class Other:\n    deterministic = True\nclass Policy:\n    pass\n", False),
        ("deterministic = True\nclass Policy:\n    pass\n", False),
        ("class Policy:\n    def act(self, obs):\n        deterministic = True\n", False),
        ("class Policy:\n    deterministic = True\nclass Policy:\n    pass\n", False),
        ("class Policy(:\n", False),
        ("\0", False),
        ("-" * 100_000 + "1", False),
        ("(" * 100_000, False),
    ],
)
def test_only_a_plain_true_in_the_class_declares(source: str, declared: bool) -> None:
    assert declares_deterministic({"policy.py": source.encode()}) is declared
    assert not declares_deterministic({"inner/policy.py": source.encode()})
