"""`evopolicy verify RUN_DIR`: a finished run's episodes played again, and their differences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import (
    CLUSTER,
    Connect,
    CredentialsFile,
    Json,
    end_on_sigterm,
    fail,
    fail_on_our_errors,
    run_to_end,
)
from evopolicy_common.cli.frame import App
from evopolicy_common.console import Terminal, terminal
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.processes.packages import packages_in
from evopolicy_common.terminal import one_line, say_json
from evopolicy_results.cli.cluster import Local, State, Where, first
from evopolicy_results.evaluations import sample as draw
from evopolicy_results.verify.run import Difference, Report, Verifier
from evopolicy_results.verify.source import read_run

DIFFERS, USAGE, UNCHECKED = 1, 2, 3

app = App(name="verify")


@app.command(
    name="verify",
    epilog="Example: evopolicy verify runs/evolve/gym_acrobot/20260131-120000 --sample 16 --local",
)
def verify(
    run: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A finished run's directory.")],
    sample: Annotated[
        int | None, typer.Option("--sample", min=1, help="Number of random episodes; default: all.")
    ] = None,
    connect: Connect = None,
    file: CredentialsFile = None,
    local: Local = False,
    state: State = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="With --local: the run's folder of split files.",
            rich_help_panel=CLUSTER,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Replay a run's recorded actions, and compare rewards, observations and returns bit for bit.

    Also compares the other numbers of the run directory with each other, and with the result of the run's
    coordinator. Without that coordinator, consistent edits are found only where a train episode shows them. Re-scores
    are not played again. Exit codes: 0 identical, 1 something differs, 2 wrong usage or other cases than the run's, 3
    not all could be checked.
    """
    where = Where(connect, file, local, state, data, runs=[run], needs_state=False)
    console = terminal(stderr=as_json)

    async def work() -> Report:
        end_on_sigterm()
        finished = read_run(run)
        packages = packages_in(finished.record.versions.fingerprint)
        async with where.playing("verify", console, packages) as playing:
            verifier = Verifier(playing.evaluations, finished)
            knows_run = await verifier.check_cases()
            lists = [*finished.train, *(finished.hidden if knows_run else ())]
            sizes = [len(played.env_instances) for played in lists]
            if verifier.skips(sum(sizes)):
                return verifier.report
            chosen = [(lists[k], indexes) for k, indexes in draw(sizes, sample or sum(sizes))]
            if not chosen:
                raise ConfigError(f"{run} has no episode to play again, as no submit was ok")
            notes = verifier.report.notes
            if not knows_run:
                notes.append(
                    "this coordinator has no record of the run: actions are those of the feedback files, hidden"
                    " episodes are not checked, policies get other seeds than they had, and edits that agree"
                    " with each other are found only where a train episode that is played again shows them"
                )
            total = sum(len(indexes) * (1 + (one.split == "train")) for one, indexes in chosen)
            playing.update(total=total)

            async def replay_chosen() -> None:
                for played, indexes in chosen:
                    await verifier.replay(played, indexes)
                    if played.split == "train":
                        await verifier.play_policy(played, indexes)
                await verifier.check_fingerprint()

            await playing.run_work([finished.record.env], {finished.record.sandbox_tier}, replay_chosen)
        return verifier.report

    with fail_on_our_errors():
        try:
            report = run_to_end(work())
        except ConfigError:
            raise
        except EvopolicyError as error:
            fail(str(error), UNCHECKED)
    if as_json:
        say_json(report)
    else:
        _print(report, console)
    raise typer.Exit(DIFFERS if not report.identical else UNCHECKED if report.unchecked_episodes else 0)


def _print(report: Report, console: Terminal) -> None:
    def say(text: str) -> None:
        console.print(one_line(text), soft_wrap=True)

    def listed(heading: str, lines: Sequence[str | Difference]) -> None:
        texts = [each if isinstance(each, str) else f"{each.episode}: {each.difference}" for each in lines]
        for line in [heading, *(f"  {each}" for each in first(texts))] if texts else ():
            say(line)

    for note in report.notes:
        say(f"note: {note}")
    listed("library versions differ:", report.fingerprint_differences)
    listed("not checked:", report.not_checked)
    listed("differs:", report.differences)
    source = f", {report.from_files} of them from feedback files" if report.from_files else ""
    verdict = "identical" if report.identical else "NOT identical"
    unchecked = report.unchecked_episodes
    rest = f"; {unchecked} further episodes could not be checked" if unchecked else ""
    say(f"{report.env}: recorded actions of {report.episodes} episodes{source}: {verdict}{rest}")
    if total := report.policy_episodes:
        listed("policy again, advisory:", report.policy_differences)
        same = total - len(report.policy_differences)
        say(f"policy again (advisory): {same} of {total} episodes the same")
