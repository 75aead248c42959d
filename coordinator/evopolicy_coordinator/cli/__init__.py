"""The coordinator's commands: `evopolicy-coordinator …`, and those that it adds to `evopolicy`."""

from __future__ import annotations

from evopolicy_common.cli.frame import needed_extras


def program() -> None:
    """The program: where the extra is not installed, it says so before anything is imported."""
    with needed_extras():
        from evopolicy_coordinator.cli.main import main
    main()
