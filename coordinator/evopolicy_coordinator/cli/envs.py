"""`evopolicy envs`: the environments that the cluster's workers offer, and the operator's word for those that do not
ship."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Annotated

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.cli.conventions import Connect, CredentialsFile, Json
from evopolicy_common.cli.frame import App
from evopolicy_common.console import listing, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import OfferedEnvironment
from evopolicy_common.terminal import say, say_json, say_lines
from evopolicy_common.wire.operator_client import OperatorClient
from evopolicy_coordinator.cli.status import asking

app = App()
_COLUMNS: dict[str, Callable[[OfferedEnvironment], str]] = {
    "environment": lambda one: one.description.env,
    "family": lambda one: _family(one.description.family),
    "definition": lambda one: one.digest,
    "accepted": lambda one: one.accepted,
    "steps": lambda one: f"{one.description.max_episode_steps:,}",
    "µs a step": lambda one: f"{one.description.step_us:,.0f}" if one.description.step_us else "",
    "repeats": lambda one: "yes" if one.description.deterministic else "no",
    "renders": lambda one: "yes" if one.description.renders else "no",
    "workers": lambda one: ", ".join(one.workers),
}


@app.callback(invoke_without_command=True, epilog="Example: evopolicy envs --env 'my/*'")
def envs(
    context: typer.Context,
    connect: Connect = None,
    file: CredentialsFile = None,
    env: Annotated[
        str | None,
        typer.Option(help="Suite, glob, or an id, which also shows the task text."),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the environments that the cluster's workers offer, their definitions, and whether runs may use them."""
    if context.invoked_subcommand is not None:
        return
    offered, later, failed = asking(connect, file, OperatorClient.environments)
    wanted = [each for each in offered if _wanted(each.description.env, env)]
    later = {each: workers for each, workers in later.items() if _wanted(each, env)}
    failed = {each: reasons for each, reasons in failed.items() if _wanted(each, env)}
    if as_json:
        say_json(
            [
                *wanted,
                *({"env": each, "workers": workers, "described": False} for each, workers in later.items()),
                *({"env": each, "failed": reasons} for each, reasons in failed.items()),
            ]
        )
        return
    if env is not None and env not in catalogue.suites() and not set("*?[") & {*env}:
        _show(env, wanted, later, failed)
        return
    shown = listing(wanted, _COLUMNS, right=("steps", "µs a step"), whole=("environment", "definition"))
    for each, workers in later.items():
        entry = catalogue.entry(each)
        steps, names = f"{entry.max_episode_steps:,}", ", ".join(workers)
        shown.add_row(each, _family(entry.family), "on first use", "", steps, "", "", "", names)
    if wanted or later:
        terminal().print(shown)
    elif not failed:
        say("no connected worker offers such an environment")
    say_lines(_failures(failed))
    if wanted or later or failed:
        return
    lacking = [installs.advice(each) for each in catalogue.entries() if env and _wanted(each, env)]
    for line in dict.fromkeys(filter(None, lacking)):
        say(line)


@app.command("approve", epilog="Example: evopolicy envs approve my/glider@0123456789abcdef")
def approve(
    environment: Annotated[
        str, typer.Argument(help="ID@DIGEST, as `evopolicy envs` shows them.", show_default=False)
    ],
    connect: Connect = None,
    file: CredentialsFile = None,
) -> None:
    """Approve a definition of an environment that does not come with evopolicy, so that runs may use it."""
    env, at, digest = environment.partition("@")
    if not at:
        raise ConfigError(f"{environment}: use the form ID@DIGEST; `evopolicy envs` shows both")
    asking(connect, file, lambda operator: operator.approve(env, digest))
    say(f"{env} may be used in definition {digest}")


def _family(key: str) -> str:
    return catalogue.families().get(key, key)


def _wanted(env: str, pattern: str | None) -> bool:
    suites = catalogue.suites()
    if pattern in suites:
        return env in suites[pattern].environments
    return pattern is None or fnmatch.fnmatchcase(env, pattern)


def _failures(failed: Mapping[str, Mapping[str, str]]) -> Iterator[str]:
    for env, reasons in failed.items():
        for worker, why in reasons.items():
            yield f"{env} failed on {worker}, which does not offer it: {why}"


def _show(
    env: str,
    wanted: list[OfferedEnvironment],
    later: Mapping[str, Collection[str]],
    failed: Mapping[str, Mapping[str, str]],
) -> None:
    if env in later:
        raise ConfigError(
            f"{env} is described when its first run waits for it, by {', '.join(later[env])}; to see it before, start a"
            " worker that offers it alone"
        )
    if not wanted:
        if failed:
            raise ConfigError("; ".join(_failures(failed)))
        advice = installs.advice(env)
        raise ConfigError(
            f"no connected worker offers {env}" + (f"; {advice}" if advice else catalogue.near(env))
        )
    for each in wanted:
        fields = msgspec.to_builtins(each.description)
        text = fields.pop("task_text")
        say(f"{each.description.env}@{each.digest}: {each.accepted}, offered by {', '.join(each.workers)}")
        say_json(fields)
        say(text)
