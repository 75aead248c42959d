"""`evopolicy-worker`: offers this machine's cores to a cluster."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import itertools
import os
import secrets
import shutil
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, cast

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.cli.conventions import fail, fail_on_our_errors, setup_logging
from evopolicy_common.cli.frame import App, Version, run_app
from evopolicy_common.console import filled_table, terminal
from evopolicy_common.errors import ConfigError, MachineError, SandboxError
from evopolicy_common.logs import log
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import distribution, proc
from evopolicy_common.processes.notices import notify_of_many_slots
from evopolicy_common.processes.packages import checked_names, policy_versions
from evopolicy_common.processes.preflight import check_scratch
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.terminal import say
from evopolicy_common.wire import credentials, keys, transport
from evopolicy_common.wire.credentials import read_ready
from evopolicy_worker import capabilities, check_env, environments, setup
from evopolicy_worker.capabilities import Capabilities, describe_all, log_missing
from evopolicy_worker.doctor import best_tier, examine
from evopolicy_worker.environments.interface.calls import USUAL, EnvironmentLimits
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.slots.slot import SANDBOXED, Slot, available_tiers, try_out, why_not
from evopolicy_worker.supervisor import MAX_PREPARED, Supervisor, WorkerOptions

app = App()


@app.callback(invoke_without_command=True)
def work(
    context: typer.Context,
    env: Annotated[
        list[str] | None,
        typer.Option(
            help=(
                "Suite (core16), id (gym/acrobot), glob (gymnasium/MiniGrid-*), environment file"
                " (lander.toml) or module:Id; may be repeated."
            )
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint of the coordinator or of a router, such as tls/10.0.0.5:7447."),
    ] = None,
    slots: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Episodes at the same time; default: one for each core."),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(
            help="Name of this worker; default: its certificate's, or the host's with a random suffix."
        ),
    ] = None,
    credentials_file: Annotated[
        Path | None,
        typer.Option(
            "--credentials", help="Folder of `evopolicy-coordinator certs issue worker`, or the file in it."
        ),
    ] = None,
    policy_package: Annotated[
        list[str] | None,
        typer.Option(
            help="Package that policies may import in addition to numpy; may be repeated.",
        ),
    ] = None,
    unsandboxed: Annotated[
        bool,
        typer.Option(
            "--unsandboxed",
            help="Also play runs with tier none: their policies run without a sandbox, with your rights.",
        ),
    ] = False,
    ready_file: Annotated[
        Path | None,
        typer.Option(
            "--ready-file",
            hidden=True,
            help="File with credentials that a starting coordinator will write.",
        ),
    ] = None,
    need_tier: Annotated[
        list[str] | None,
        typer.Option(
            "--need-tier",
            hidden=True,
            help="Sandbox tier without which the worker does not start; it offers no other.",
        ),
    ] = None,
    env_timeout: Annotated[
        float,
        typer.Option(
            min=1.0,
            help="Time limit of one call of an environment, in seconds.",
        ),
    ] = USUAL.call_s,
    env_memory: Annotated[
        int, typer.Option(min=64, help="Memory limit of an environment's process, in MiB.")
    ] = USUAL.memory_bytes >> 20,
    grace: Annotated[
        float,
        typer.Option(min=0.0, help="Seconds for running episodes to finish after SIGTERM."),
    ] = 10.0,
    _: Version = False,
) -> None:
    """Run a worker: lease episodes from a coordinator and play them, with policies in a sandbox.

    Example: evopolicy-worker --env core16 --connect tls/10.0.0.5:7447 --credentials gpu-7

    Waits until the coordinator answers. After SIGTERM or Ctrl-C it finishes running episodes, returns its other leases,
    and exits.
    """
    if context.invoked_subcommand is not None:
        return
    setup_logging()
    with fail_on_our_errors():
        if not env:
            raise ConfigError(
                f"--env is missing: name a suite ({', '.join(catalogue.suites())}), an id or a glob"
            )
        if name is not None and not keys.valid_name(name):
            raise ConfigError(f"--name {name!r}: letters, digits, '.', '_' and '-' only, 63 at most")
        packages = checked_names(policy_package)
        wanted = catalogue.resolve(env)
        environments.check_played(wanted)
        # Until the worker can drain, SIGTERM raises SystemExit, so that processes and temporary folders are cleaned up.
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
        check_scratch()

        find = partial(credentials.find, "worker", tuple(connect or ()), credentials_file)
        # Wrong credentials are reported at once. With --ready-file they do not exist yet.
        known = None if ready_file else find()
        needed = cast("tuple[Tier, ...]", tuple(need_tier or ()))
        if len(needed) == 1 and needed[0] in SANDBOXED:
            # The first slot tests the tier when it starts.
            tiers: tuple[Tier, ...] = (*needed, "none") if unsandboxed else needed
        else:
            tiers = available_tiers(unsandboxed=unsandboxed, wanted=needed or SANDBOXED)
        missing = {tier: why_not(tier) or "" for tier in needed or SANDBOXED if tier not in (*tiers, "none")}
        log_missing(missing)
        if not tiers:
            raise MachineError(
                "no sandbox works on this machine: `evopolicy-worker doctor` names the cause and the remedy;"
                " --unsandboxed plays runs with --tier none"
            )
        for tier in needed:
            if tier not in tiers:
                raise _refused(tier, missing.get(tier), unsandboxed=unsandboxed)
        limits = EnvironmentLimits(call_s=env_timeout, memory_bytes=env_memory << 20)
        with scratch_folder("worker") as scratch:
            own = (name, wanted, tiers, missing, slots, packages, limits, scratch, grace)
            try:
                asyncio.run(_run(find, known, ready_file, *own))
            except SandboxError as error:
                if not needed:
                    raise
                raise _refused(tiers[0], str(error), unsandboxed=unsandboxed) from error


@app.command("doctor")
def doctor() -> None:
    """Check which sandbox tiers work on this machine.

    Example: evopolicy-worker doctor

    Exit code 0 if a sandboxed tier works, 1 if only `none` does.
    """
    checks = tuple(examine())
    best = best_tier(checks)
    rows = [(each.name, each.verdict, each.found, each.advice) for each in checks]
    terminal().print(filled_table(("check", "verdict", "found", "remedy"), rows))
    say(
        f"tier: {best or 'none (policies would not be locked in: a worker needs --unsandboxed, a run --tier none)'}"
    )
    raise typer.Exit(0 if best else 1)


app.command("check-env")(check_env.command)
app.command("setup")(setup.command)


def _refused(tier: Tier, why: str | None, *, unsandboxed: bool) -> ConfigError:
    advice = "`evopolicy-worker doctor` checks this machine"
    if tier == "bwrap" and shutil.which("bwrap") is not None:
        advice = f"permit user namespaces ({distribution.permit_namespaces()})"
    return ConfigError(
        f"sandbox tier {tier} does not work here: {why}; {advice}."
        f" {_other_tier(available_tiers(unsandboxed=unsandboxed))}"
    )


def _other_tier(tiers: tuple[Tier, ...]) -> str:
    """Advice which tier a run can request instead: the safest that works here."""
    locked = [tier for tier in tiers if tier != "none"]
    if locked:
        return f"--tier {locked[0]} works here; run.json records it"
    return "--tier none plays policies unconfined, which run.json then says"


def default_name(own: credentials.Credentials) -> str:
    """The name that the machine's certificate was issued for; without one, the host's name with a random part.

    A second worker with the same certificate on this machine also gets a random part, so that names are unique.
    """
    certified = own.user.partition("/")[2]
    if not certified:
        return proc.new_worker_name()
    assert own.tls is not None
    # Never closed, so that the lock is held for the life of this process.
    fd = os.open(own.tls.certificate, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # held by another worker, or a file system without locks
        os.close(fd)
        return f"{certified[:50]}-{secrets.token_hex(3)}"
    return certified


async def _run(
    find: Callable[[], credentials.Credentials],
    joining: credentials.Credentials | None,
    ready_file: Path | None,
    name: str | None,
    env_ids: list[str],
    tiers: tuple[Tier, ...],
    missing: dict[Tier, str],
    n_slots: int | None,
    packages: tuple[str, ...],
    limits: EnvironmentLimits,
    scratch: Path,
    grace_s: float,
) -> None:
    """`joining`: the credentials; None where they do not exist before `ready_file` is written. `packages`:
    those that policies may import besides numpy."""
    notify_of_many_slots(n_slots or 0)
    taken = _take_cores(n_slots)
    importable = policy_versions(packages)
    # Environments that do not ship are defined in the processes that play them.
    foreign = tuple(catalogue.entry(env_id) for env_id in env_ids if not catalogue.is_shipped(env_id))

    def new_slot(core: int | None, slot: object, tier: Tier) -> Slot:
        own = scratch / f"slot-{slot}"
        return Slot(core, tier, own, ("numpy", *packages), definitions=foreign, limits=limits)

    first = new_slot(taken[0], 0, tiers[0])
    kept = {(0, tiers[0]): first}

    def make_slot(index: int, tier: Tier) -> Slot:
        return kept.pop((index, tier), None) or new_slot(taken[index], index, tier)

    def importing(described: Sequence[EnvironmentDescription]) -> tuple[EnvironmentDescription, ...]:
        """With the packages that policies may import, on which their results depend in every environment."""
        return tuple(msgspec.structs.replace(each, packages=each.packages | importable) for each in described)

    async def describe(wanted: Sequence[str]) -> tuple[tuple[EnvironmentDescription, ...], dict[str, str]]:
        slot = new_slot(None, "descriptions", tiers[0])
        try:
            made, failed = await describe_all(wanted, slot, cache)
        finally:
            await slot.close()
        return importing(made), failed

    async def probe(tier: Tier) -> None:
        await try_out(new_slot(None, "probe", tier))

    main = asyncio.current_task()
    assert main is not None
    supervisor: Supervisor | None = None

    def stop() -> None:
        # A second signal, or one before the supervisor exists, ends the worker at once.
        if supervisor is None or supervisor.draining.is_set():
            main.cancel()
        else:
            log.info("draining; once more to stop at once")
            supervisor.drain()

    own = fingerprint()
    cache = capabilities.Cache(own.code_version)
    try:
        known, now, later = capabilities.sorted_out(env_ids, cache)
        made, failed = await describe_all(now, first, cache)
        known += made
        if len(env_ids) > MAX_PREPARED:
            await first.close()
        if joining is None:
            assert ready_file is not None
            ready = await read_ready(ready_file, asyncio.get_running_loop().create_future())
            joining = credentials.find("worker", (), Path(ready.credentials["worker"]))
        able = Capabilities(
            tiers,
            importing(sorted(known, key=lambda each: env_ids.index(each.env))),
            missing_tiers=missing,
            undescribed=tuple(later),
            failed_environments=failed,
            probe=probe,
            describe=describe,
        )
        options = WorkerOptions(
            name=name or default_name(joining),
            slots=len(taken),
            fingerprint=msgspec.structs.replace(own, packages=own.packages | importable),
            host=socket.gethostname(),
            boot_id=proc.boot_id(),
            scratch=scratch,
            grace_s=grace_s,
        )
        if not options.boot_id:
            log.warning("this worker gets no hidden episodes", why=proc.NO_BOOT_ID)
        log.info("waiting for the coordinator", endpoints=joining.endpoints)
        connecting = transport.connect(joining, timeout_s=None, read_again=None if ready_file else find)
        with contextlib.suppress(asyncio.CancelledError):
            for number in (signal.SIGTERM, signal.SIGINT):
                asyncio.get_running_loop().add_signal_handler(number, stop)
            async with connecting as link:
                supervisor = Supervisor(link, options, able, make_slot)
                await supervisor.run()
                log.info("stopped", jobs_done=supervisor.jobs_done)
    finally:
        for slot in kept.values():
            await slot.close()


def main() -> None:
    # Slots inherit these, such as the thread counts of simulators and numpy; see `environments.process_environment`.
    os.environ.update(environments.process_environment())
    if sys.platform != "linux":
        fail("evopolicy-worker runs on Linux (or WSL2): its sandbox is made of Linux namespaces")
    run_app(app)


_CORE_NAME = "\0evopolicy-core-{}"
_core_names: list[socket.socket] = []
"""Of this process's cores, until it ends."""


def _take_cores(n: int | None) -> list[int]:
    """A core for each of `n` slots: those that no worker of this machine has taken, then all in turn. None:
    as many slots as this process has cores.

    A slot's environment and policy processes share one core: a pipe round trip costs 7 µs there and over 100 µs across
    cores. The workers of one machine coordinate by names of Unix sockets: the kernel frees a name with its process, and
    no file of another user can be in the way.
    """
    allowed = sorted(os.sched_getaffinity(0))
    n = n or len(allowed)
    taken: list[int] = []
    for core in allowed:
        if len(taken) < n:
            name = socket.socket(socket.AF_UNIX)
            try:
                name.bind(_CORE_NAME.format(core))
            except OSError:
                name.close()
                continue
            _core_names.append(name)
            taken.append(core)
    return [*taken, *itertools.islice(itertools.cycle(allowed), n - len(taken))]


if __name__ == "__main__":
    main()
