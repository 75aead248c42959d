"""Writes `docs/reference/options.md` from the declarations: `python docs/_site/options.py >
docs/reference/options.md`."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import msgspec

from evopolicy_gateway.declared import declared
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.run_options import ListenerOptions, RunOptions


def page() -> Iterator[str]:
    """The page's lines."""
    yield "# Options of a run\n"
    yield (
        "One table for the command line (`evopolicy run`, `local`), for `[defaults]`, `[agents.run]` and"
        " `[[overrides]]` of a suite file (`jail.…`: in `[agents.jail]`), and for `evp.run` in Python."
        " The second column has the name in suite files and in Python."
        " [Commands](cli.md) has the options of every command, with those of a local cluster."
    )
    options = [one for each in (RunOptions, JailSettings, ListenerOptions) for one in declared(each).items()]
    for group, members in groupby(options, lambda each: each[1].group):
        yield f"\n## {group}\n\n| option | elsewhere | meaning |\n|---|---|---|"
        for name, one in members:
            everywhere = name in RunOptions.__struct_fields__
            suite, python = everywhere and one.option.suite is not None, everywhere and one.option.python
            alone = "" if suite and python else " (suite)" if suite else " (Python)"
            text = f"`{name}`{alone}" if suite or python else ""
            if name in JailSettings.__struct_fields__:
                text = f"`jail.{name}`"
            yield f"| `{one.flag}` | {text} | {one.help}{_default(one.default)} |"


def _default(value: Any) -> str:
    if value in (None, ()) or value is False or isinstance(value, msgspec.Struct):
        return ""
    return "; required" if value is msgspec.NODEFAULT else f" Default: {value}."


if __name__ == "__main__":
    print("\n".join(page()))
