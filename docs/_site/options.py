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
        "Options of `evopolicy run` and `local`; keys of `[defaults]`, `[agents.run]` and `[[overrides]]` in a suite"
        " file (`jail.…`: in `[agents.jail]`); keywords of `evp.run` in Python. Keys and keywords have the same names"
        " with underscores, such as `exp_id`, unless another is given. [Commands](cli.md) has all other options."
    )
    options = [one for each in (RunOptions, JailSettings, ListenerOptions) for one in declared(each).items()]
    for group, members in groupby(options, lambda each: each[1].group):
        yield f"\n## {group}\n"
        for name, one in members:
            everywhere = name in RunOptions.__struct_fields__
            suite, python = everywhere and one.option.suite is not None, everywhere and one.option.python
            text = "" if suite and python else " (not in Python)" if suite else " (not in suite files)"
            text = text if suite or python else " (command line only)"
            if name in JailSettings.__struct_fields__:
                text = f", `jail.{name}`"
            elif (
                one.flag.replace("-", "_").removeprefix("__").removesuffix("=…").removeprefix("set ") != name
            ):
                text = f", `{name}`{text}"
            yield f"- `{one.flag}`{text}: {one.help}{_default(one.default)}"


def _default(value: Any) -> str:
    if value in (None, ()) or value is False or isinstance(value, msgspec.Struct):
        return ""
    return "; required" if value is msgspec.NODEFAULT else f" Default: {value}."


if __name__ == "__main__":
    print("\n".join(page()))
