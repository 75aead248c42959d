"""The `evopolicy` and `evopolicy-gateway` commands."""

from __future__ import annotations

from evopolicy_common.cli.frame import needed_extras


def gateway_program() -> None:
    """The program `evopolicy-gateway`: where the extra is not installed, it says so before anything is imported."""
    with needed_extras():
        from evopolicy_gateway.cli.serve import main
    main()
