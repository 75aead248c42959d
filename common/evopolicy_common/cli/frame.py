"""The frame of every command: grouped help, `--version`, shell completion, usage errors, and missing extras."""

from __future__ import annotations

import contextlib
import math
import platform
import re
import sys
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

import evopolicy_common
from evopolicy_common.cli.conventions import USAGE_ERROR, fail, fail_on_our_errors, setup_notices
from evopolicy_common.entry import interruptible
from evopolicy_common.processes.preflight import EXTRAS, missing
from evopolicy_common.terminal import end_without_reader, harmless, one_line, open_streams, say, shortened

Function = TypeVar("Function", bound=Callable[..., Any])

_SETTINGS = {"help_option_names": ["-h", "--help"]}
_WRONG = {
    "int_parsing": "is not a whole number",
    "float_parsing": "is not a number",
    "greater_than_equal": "is less than {ge}",
    "less_than_equal": "is more than {le}",
}
"""Faults of an option's value by the name that typer's library gives them; its texts lack the value."""
_MOST_CHARACTERS = 32_768
"""Of an option's value: no list of cases and no agent's command is longer."""
SEVERAL_LINES = frozenset({"agent"})
"""Parameters whose values may have several lines: an agent may be a shell script."""
_METAVARS = {"str": "TEXT", "int": "N", "float": "X", "path": "PATH", "file": "PATH", "directory": "DIR"}
"""How help shows values, by the name of their type."""
_VALUE = re.compile(r"<(?:list\[)?(\w+)(?: range)?\]?>")


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"evopolicy {evopolicy_common.__version__} (Python {platform.python_version()})")
        raise SystemExit(0)


Version = Annotated[
    bool,
    typer.Option(
        "--version",
        is_eager=True,
        callback=_show_version,
        help="Show the version and exit.",
        show_default=False,
    ),
]
"""Option of each program's top level."""


class _Help:
    """Lists options under their `rich_help_panel` in plain text, which folds on narrow terminals and suits pipes."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        groups: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):  # type: ignore[attr-defined]
            record = param.get_help_record(ctx)
            if record is None:
                continue
            usual = "Options" if param.param_type_name == "option" else "Arguments"
            name = getattr(param, "rich_help_panel", None) or usual
            # `--runs <path>` as `--runs PATH`, `--env <list[str]>` as `--env TEXT`; choices stay unchanged.
            shown = _VALUE.sub(lambda match: _METAVARS.get(match[1].lower(), match[0]), record[0])
            groups.setdefault(name, []).append((shown, record[1]))
        if "Options" in groups:  # last: grouped options are more specific
            others = groups.pop("Options")
            groups["Other options" if groups.keys() - {"Arguments"} else "Options"] = others
        for name, records in groups.items():
            with formatter.section(name):
                formatter.write_dl(records)
        if isinstance(self, TyperGroup):
            self.format_commands(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if ctx.resilient_parsing:
            return super().parse_args(ctx, args)  # type: ignore[misc,no-any-return]
        given, _, _ = self.make_parser(ctx).parse_args(args=list(args))  # type: ignore[attr-defined]
        named = []
        for param in self.get_params(ctx):  # type: ignore[attr-defined]
            values = given.get(param.name)
            values = values if isinstance(values, list | tuple) else [values]
            named += [(param, value) for value in values if isinstance(value, str)]
        for param, value in named:
            if why := _unusable(value, several_lines=param.name in SEVERAL_LINES):
                # A byte that is not UTF-8 is shown as the shell has it.
                shown = repr(shortened(value)).replace(r"\udc", r"\x")
                raise typer.BadParameter(f"{shown} {why}", ctx=ctx, param=param)
        rest: list[str] = super().parse_args(ctx, args)  # type: ignore[misc]
        for param, value in named:
            number = ctx.params.get(param.name)
            # Python's numbers may be `inf`, `nan` and `1_000`.
            if isinstance(number, int | float) and (not math.isfinite(number) or "_" in value):
                why = f"{shortened(value)!r} is not a finite number in digits"
                raise typer.BadParameter(why, ctx=ctx, param=param)
        return rest

    def invoke(self, ctx: object) -> Any:
        if not isinstance(self, TyperGroup) or self.invoke_without_command:
            interruptible()
        setup_notices()  # not earlier: help and completion log nothing and do not need structlog
        with fail_on_our_errors():
            return super().invoke(ctx)  # type: ignore[misc]


class Command(_Help, TyperCommand):
    """A command with grouped help."""


class CommandGroup(_Help, TyperGroup):
    """A command group; without a subcommand it shows its help and exits with a usage error."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for heading, rows in self.command_groups(ctx).items():
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def command_groups(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        """By heading: the names of the commands, with a short help text each."""
        shown = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        # Whole sentences, folded: typer would truncate them to one line.
        rows = [(name, each.get_short_help_str(1000)) for name, each in shown if each and not each.hidden]
        return {"Commands": rows}

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args and self.no_args_is_help and not ctx.resilient_parsing:
            say(ctx.get_help(), err=True)
            raise typer.Exit(USAGE_ERROR)
        return super().parse_args(ctx, args)


class App(typer.Typer):
    """Our `typer.Typer`: `-h`, plain grouped help, and no traceback formatting by typer."""

    def __init__(self, **options: Any) -> None:
        usual = {"cls": CommandGroup, "rich_markup_mode": None, "add_completion": False}
        super().__init__(**(usual | {"context_settings": _SETTINGS} | options))

    def command(self, name: str | None = None, **options: object) -> Callable[[Function], Function]:
        """As typer's; the command has grouped help and accepts `-h`."""
        usual: dict[str, Any] = {"cls": Command, "context_settings": _SETTINGS}
        return super().command(name, **(usual | options))


def run_app(app: typer.Typer, extra: str | None = None) -> NoReturn:
    """Runs the command that `sys.argv` names, and exits. `extra`: the one it needs; None: by module."""
    open_streams()
    end_without_reader()
    try:
        with needed_extras(extra), fail_on_our_errors():
            code = typer.main.get_command(app).main(standalone_mode=False)
    except TyperException as error:
        fail(_usage_text(error), USAGE_ERROR)
    except (typer.Abort, KeyboardInterrupt):
        fail("interrupted", 130)
    if code == 130:  # newer typers turn KeyboardInterrupt into this
        fail("interrupted", 130)
    raise SystemExit(code if isinstance(code, int) else 0)


@contextlib.contextmanager
def needed_extras(needed: str | None = None) -> Iterator[None]:
    """Ends the command when the body misses a module, and names the extra to install: `needed`, or the
    module's. Version and help are answered as far as possible."""
    try:
        yield
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        _show_version(sys.argv[1:] == ["--version"])
        advice = missing(needed or extra, error.name or "")
        if {"-h", "--help"} & set(sys.argv):
            advice += "; until then, `evopolicy files docs/reference/cli.md` names a page with all commands and options"
        fail(advice)


def _unusable(value: str, *, several_lines: bool) -> str:
    """Why no option takes this value; empty if one may."""
    if not value.strip():
        return "is empty"
    if len(value) > _MOST_CHARACTERS:
        return f"has {len(value):,} characters, and {_MOST_CHARACTERS:,} are the limit"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "is not UTF-8, which names and messages are"
    shown = harmless(value) if several_lines else one_line(value)
    return "" if shown == value else "has characters that cannot be printed"


def _usage_text(error: TyperException) -> str:
    errors: list[Any] = getattr(error.__cause__, "errors", list)()
    if errors and errors[0]["type"] in _WRONG:
        error.message = (
            f"{errors[0]['input']!r} {_WRONG[errors[0]['type']].format(**errors[0].get('ctx', {}))}"
        )
    text = " ".join(str(error.format_message()).split()).replace("Value error, ", "") or "wrong usage"
    context = getattr(error, "ctx", None)
    if context is None:
        return text
    name = getattr(error, "option_name", "").lstrip("-").replace("-", "_")
    settings = next((each.help for each in context.command.params if "--set" in each.opts), "")
    if name and re.search(rf"[:,] {re.escape(name)}[,;]", settings):
        return f"{text.rstrip('.')}; give it as --set {name}=VALUE"
    return f"{text.rstrip('.')}; see {context.command_path} --help"
