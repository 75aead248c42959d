"""Every timeout in the code is made to fire by some test: this table says by which, and is held to the code and the tests.

Collected from the sources: constants and defaults named `…_S`, `…_s`, `…_MS` or `…LINGER`, and numbers given as a `timeout`. Each is either
a timeout, a limit after which something is given up, ended or forgotten, and then some test lets it pass; or it is no such
limit, and then a word says what it is: `pace` (how often, how long between two tries, how long a poll may be held), `size` (a
bound on another duration, a share, a unit), which no fault lets pass.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = {
    "common": "common/evopolicy_common",
    "coordinator": "coordinator/evopolicy_coordinator",
    "worker": "worker/evopolicy_worker",
    "gateway": "agent_gateway/evopolicy_gateway",
}
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*_M?S|([A-Z]+_)?LINGER")
FIELD = re.compile(r"[a-z][a-z0-9_]*_m?s")
CALLS = frozenset({"timeout", "wait_for", "settimeout", "join"})

DOCUMENT = ROOT / "docs" / "reliability.md"
PACE, SIZE = "pace", "size"

LOCAL = "tests/unit/common/test_local_cluster.py::"
LEASES = "tests/unit/coordinator/core/test_core_leases.py::"
SCHEDULER = "tests/unit/coordinator/core/test_core_scheduler.py::"
SHELL = "tests/unit/coordinator/test_coordinator_timeouts.py::"
WORKER = "tests/unit/worker/runtime/test_worker_timeouts.py::"
VERDICTS = "tests/unit/worker/runtime/test_slot_verdicts.py::"
SUPERVISOR = "tests/integration/worker/test_supervisor.py::"
WIRE = "tests/integration/transport/test_timeouts_on_the_wire.py::"
GATEWAY = "tests/unit/gateway/test_gateway_timeouts.py::"
DOORS = "tests/unit/gateway/jail/test_jail_doors.py::"
CLIS = "tests/unit/gateway/harnesses/test_cli_agents.py::"
COMMAND = "tests/integration/gateway/test_run_command.py::"

TIMEOUTS: dict[str, str] = {
    # What a policy may take.
    "common/messages/episode.py:episode_wall_s": VERDICTS
    + "test_a_limit_of_time_is_told_with_its_value_and_what_was_used",
    "common/messages/episode.py:act_wall_s": VERDICTS
    + "test_a_limit_of_time_is_told_with_its_value_and_what_was_used",
    "common/messages/episode.py:init_wall_s": VERDICTS
    + "test_a_bundle_without_a_policy_is_told_at_index_0_and_not_played",
    "common/messages/episode.py:cpu_s": VERDICTS
    + "test_a_limit_of_time_is_told_with_its_value_and_what_was_used",
    # On the wire.
    "common/requests.py:ANSWER_S": WIRE + "test_a_question_that_is_not_answered_fails",
    "common/requests.py:WARN_AFTER_S": WIRE
    + "test_who_asks_again_says_why_he_waits_and_gives_up_when_his_patience_ends",
    "common/transport.py:STUCK_S": WIRE + "test_a_session_that_is_stuck_is_given_up",
    "common/transport.py:_CLOSE_S": WIRE + "test_a_session_that_is_stuck_is_given_up",
    "common/transport.py:connect(timeout_s)": "tests/integration/transport/test_access.py::test_a_wrong_password_is_not_let_in",
    "coordinator/verify_run.py:_PATIENCE_S": WIRE + "test_a_verification_gives_up",
    "gateway/operations.py:_PATIENCE_S": WIRE + "test_an_operators_command_gives_up",
    "gateway/session.py:STATE_PATIENCE_S": WIRE + "test_info_is_answered_without_a_state_that_does_not_come",
    # The coordinator's core.
    "coordinator/core/settings.py:lease_ttl_s": LEASES
    + "test_a_lease_of_a_silent_worker_goes_to_another_under_the_next_attempt",
    "coordinator/core/settings.py:liveness_grace_s": LEASES + "test_a_liveliness_hint_is_no_proof",
    "coordinator/core/settings.py:adoption_s": LEASES
    + "test_what_nobody_claims_after_a_restart_is_leased_under_a_higher_attempt",
    "coordinator/core/settings.py:late_s": LEASES
    + "test_after_the_loop_stood_still_nothing_expires_for_one_time_to_live",
    "coordinator/core/settings.py:silence_s": LEASES
    + "test_a_limit_verdict_of_a_worker_that_was_silent_for_long_is_not_counted",
    "coordinator/core/settings.py:standstill_s": LEASES
    + "test_a_limit_verdict_of_a_job_during_which_the_loop_stood_still_is_not_counted",
    "coordinator/core/settings.py:avoid_s": SCHEDULER
    + "test_a_train_job_stops_hidden_ones_on_the_worker_it_failed_on_once_it_may_go_there_again",
    "coordinator/core/settings.py:job_deadline_s": LEASES
    + "test_a_job_that_is_played_for_ever_is_taken_away",
    "coordinator/core/settings.py:stall_s": SCHEDULER
    + "test_what_waits_too_long_is_named_with_what_it_waits_for",
    "coordinator/core/settings.py:max_wait_s": LEASES + "test_no_poll_waits_longer_than_the_longest_wait",
    "coordinator/core/settings.py:audit_wait_s": "tests/unit/coordinator/core/test_core_audits.py::"
    "test_a_run_waits_for_a_busy_second_worker_up_to_its_bound",
    "coordinator/core/leases.py:FORGET_S": LEASES + "test_a_lost_worker_is_forgotten_in_the_end",
    # Its shell.
    "coordinator/service.py:_FORGET_S": SHELL + "test_a_query_that_nobody_waits_for_any_more_is_let_go",
    "coordinator/turned_away.py:KEPT_S": "tests/unit/coordinator/test_turned_away.py::"
    "test_only_so_many_are_kept_and_only_for_a_while",
    "coordinator/store.py:BUSY_TIMEOUT_S": SHELL + "test_a_database_that_another_keeps_locked_is_told",
    "coordinator/upkeep.py:BUSY_TIMEOUT_S": SHELL + "test_a_database_that_another_keeps_locked_is_told",
    "coordinator/upkeep.py:UNNAMED_S": "tests/integration/coordinator/test_coordinator_upkeep.py::"
    "test_a_blob_that_nothing_names_goes_once_it_is_old",
    "coordinator/watchdog.py:GAP_S": "tests/unit/coordinator/test_watchdog.py::test_gap_is_counted_and_its_place_named",
    # The worker.
    "worker/policy_process.py:_GRACE_S": WORKER
    + "test_a_policy_that_does_not_let_go_of_its_output_is_not_waited_for",
    "worker/policy_process.py:_SEAL_S": WORKER + "test_a_child_that_does_not_seal_itself_is_killed",
    "worker/recording.py:START_S": WORKER + "test_a_video_that_takes_too_long_is_done_without",
    "worker/recording.py:FRAME_S": WORKER + "test_a_video_that_takes_too_long_is_done_without",
    "worker/recording.py:MAX_S": WORKER + "test_a_video_that_takes_too_long_is_done_without",
    "worker/sandbox/doctor.py:_PATIENCE_S": WORKER + "test_a_bubblewrap_that_does_not_answer_is_missing",
    "worker/sandbox/zygote.py:START_TIMEOUT_S": WORKER + "test_a_zygote_that_does_not_start_is_told",
    "worker/sandbox/zygote.py:ANSWER_TIMEOUT_S": WORKER + "test_a_zygote_that_stands_still_has_died",
    "worker/sandbox/zygote.py:DEATH_TIMEOUT_S": WORKER
    + "test_a_policys_process_that_survives_being_killed_is_told",
    "worker/slot.py:START_TIMEOUT_S": WORKER + "test_a_slot_that_does_not_start_is_ended",
    "worker/slot.py:CANCEL_TIMEOUT_S": WORKER + "test_a_slot_that_does_not_heed_a_cancel_is_ended",
    "worker/slot.py:LAST_WORDS_S": WORKER
    + "test_a_slots_process_that_hangs_up_and_stays_is_told_without_its_status",
    "worker/supervisor.py:grace_s": SUPERVISOR + "test_a_drained_worker_hands_back_what_it_has_not_played",
    "worker/supervisor.py:CANCEL_PATIENCE_S": SUPERVISOR
    + "test_a_slot_that_heeds_nothing_does_not_hold_up_the_workers_end",
    "worker/supervisor.py:WITHDRAW_PATIENCE_S": SUPERVISOR
    + "test_a_worker_whose_coordinator_is_away_ends_all_the_same",
    # The agents.
    "gateway/agents/client.py:answer_s": GATEWAY + "test_an_agent_gives_up_on_a_gateway_that_says_nothing",
    "gateway/agents/client.py:patience_s": "tests/unit/gateway/agents/test_evolve_client.py::"
    "test_gateway_that_stays_away_is_given_up_after_the_patience",
    "gateway/harnesses/agent_config.py:silence_s": CLIS
    + "test_a_silent_cli_is_ended_and_its_session_resumed",
    "gateway/harnesses/agent_config.py:max_pause_s": CLIS + "test_pauses_have_an_end",
    "gateway/harnesses/agent_process.py:_LAST_WORDS_S": GATEWAY + "test_pipes_that_a_child_holds_are_let_go",
    "gateway/harnesses/base.py:_INFO_TIMEOUT_S": GATEWAY + "test_info_that_does_not_come_is_not_waited_for",
    "gateway/harnesses/cli_agent.py:_PROBE_PATIENCE_S": GATEWAY
    + "test_a_cli_that_does_not_tell_its_version_is_named",
    "gateway/harnesses/command.py:_PIPE_PATIENCE_S": GATEWAY + "test_pipes_that_a_child_holds_are_let_go",
    "gateway/harnesses/command.py:_STOP_PATIENCE_S": GATEWAY
    + "test_a_program_that_has_said_stop_and_stays_is_not_waited_for",
    "gateway/harnesses/keeper.py:END_GRACE_S": COMMAND
    + "test_an_agent_that_stays_when_its_budget_is_spent_is_ended_even_if_it_ignores_being_asked",
    "gateway/harnesses/keeper.py:LAST_WORDS_S": GATEWAY
    + "test_a_harness_that_does_not_end_with_its_programs_is_cut_off",
    "gateway/harnesses/turn.py:DONE_PATIENCE_S": GATEWAY
    + "test_a_cli_that_is_done_and_does_not_exit_is_ended",
    "gateway/harnesses/turn.py:_KILL_GRACE_S": GATEWAY + "test_a_cli_that_is_done_and_does_not_exit_is_ended",
    "gateway/harnesses/turn.py:_PIPE_PATIENCE_S": GATEWAY
    + "test_a_child_of_a_cli_that_holds_its_pipe_does_not_hold_up_the_turn",
    "gateway/jail/doors.py:_HEAD_PATIENCE_S": DOORS
    + "test_a_jailed_program_that_asks_for_nothing_is_hung_up_on",
    "gateway/jail/doors.py:_CONNECT_PATIENCE_S": DOORS + "test_a_named_host_that_does_not_answer_is_told",
    "gateway/jail/settings.py:_PATIENCE_S": GATEWAY + "test_a_bubblewrap_that_hangs_builds_no_jail",
    # The gateway's service.
    "gateway/http.py:BODY_WAIT_S": GATEWAY
    + "test_a_body_that_does_not_come_is_refused_and_its_rest_not_waited_for",
    "gateway/http.py:LINGER": GATEWAY
    + "test_a_body_that_does_not_come_is_refused_and_its_rest_not_waited_for",
    "gateway/http.py:STRANGER_LINGER": GATEWAY + "test_a_body_of_a_stranger_is_not_waited_for",
    "gateway/http.py:DECIDED_WAIT_S": GATEWAY
    + "test_a_submit_that_is_not_waited_for_is_answered_before_it_is_decided",
    "gateway/patience.py:HEADERS_WAIT_S": "tests/integration/gateway/test_slow_clients.py::"
    "test_headers_that_do_not_come_are_not_waited_for",
    "gateway/patience.py:ANSWER_WAIT_S": "tests/integration/gateway/test_slow_clients.py::"
    "test_an_answer_that_nobody_reads_is_not_kept_for_ever",
    "gateway/server.py:KEEP_ALIVE_S": GATEWAY + "test_an_idle_connection_is_closed",
    "gateway/server.py:CLOSE_GRACE_S": GATEWAY
    + "test_a_request_that_does_not_end_does_not_hold_up_the_services_end",
    # The operator's commands.
    "gateway/run_options.py:WALL_S": COMMAND + "test_an_agent_that_does_nothing_is_ended_by_its_wall_limit",
    "gateway/suite/suite_file.py:WALL_S": COMMAND
    + "test_an_agent_that_does_nothing_is_ended_by_its_wall_limit",
    "gateway/suite/suite_file.py:claim_ttl_s": "tests/unit/coordinator/test_claims.py::"
    "test_a_held_claim_is_not_given_to_another_until_its_time_is_up",
    "common/local_cluster.py:START_PATIENCE_S": LOCAL
    + "test_a_local_coordinator_that_does_not_start_is_told_and_killed",
    "common/local_cluster.py:END_GRACE_S": LOCAL
    + "test_a_local_coordinator_that_does_not_start_is_told_and_killed",
    "gateway/play.py:LAST_WORDS_S": COMMAND
    + "test_an_agent_that_stays_when_its_budget_is_spent_is_ended_even_if_it_ignores_being_asked",
    "gateway/play.py:END_GRACE_S": GATEWAY + "test_a_child_that_ignores_being_asked_is_killed",
    "gateway/play.py:GIVE_UP_PATIENCE_S": GATEWAY + "test_giving_up_a_run_ends_although_nobody_hears_of_it",
    "gateway/processes.py:KILL_PATIENCE_S": GATEWAY + "test_what_survives_killing_is_told",
}
"""Where it is, and the test that lets it pass."""

NO_TIMEOUTS: dict[str, str] = {
    "common/local_cluster.py:_RESTART_PAUSE_S": PACE,
    "common/ready.py:_LOOK_S": PACE,
    "common/requests.py:FIRST_PAUSE_S": PACE,
    "common/requests.py:LONGEST_PAUSE_S": PACE,
    "coordinator/claims.py:MAX_TTL_S": SIZE,
    "coordinator/core/audit.py:LOOK_AGAIN_S": PACE,
    "coordinator/remote_door.py:LOOK_S": PACE,
    "coordinator/remote_door.py:_PAUSE_S": PACE,
    "gateway/harnesses/remote.py:_LOOK_S": PACE,
    "coordinator/core/machine.py:TICK_S": PACE,
    "coordinator/core/scheduler.py:PREFETCH_BELOW_S": SIZE,
    "coordinator/core/scheduler.py:LOOK_AGAIN_S": PACE,
    "coordinator/core/settings.py:heartbeat_s": PACE,
    "coordinator/core/settings.py:retry_base_s": PACE,
    "coordinator/core/settings.py:retry_max_s": PACE,
    "coordinator/core/settings.py:batch_s": SIZE,
    "coordinator/core/settings.py:warm_bonus_s": SIZE,
    "coordinator/core/status.py:RATE_S": SIZE,
    "coordinator/request_checks.py:_MAX_WAIT_S": SIZE,
    "coordinator/service.py:_FIRST_PAUSE_S": PACE,
    "coordinator/service.py:_LONGEST_PAUSE_S": PACE,
    "coordinator/upkeep_cli.py:DAY_S": SIZE,
    "coordinator/verify_run.py:_WAIT_S": PACE,
    "coordinator/watchdog.py:_BEAT_S": PACE,
    "worker/env_process.py:_PROGRESS_S": PACE,
    "worker/heartbeat.py:ANSWERED_PAUSE_S": PACE,
    "worker/heartbeat.py:FAILED_PAUSE_S": PACE,
    "worker/monitor.py:TICK_S": PACE,
    "worker/monitor.py:_SHORTEST_TICK_S": PACE,
    "worker/recording.py:_LOOK_S": PACE,
    "worker/supervisor.py:LEASE_POLL_S": PACE,
    "worker/supervisor.py:RESTART_PAUSE_S": PACE,
    "worker/supervisor.py:LONGEST_RESTART_PAUSE_S": PACE,
    "worker/video.py:EPISODE_S": SIZE,
    "gateway/agents/client.py:poll_s": PACE,
    "gateway/harnesses/agent_config.py:backoff_s": PACE,
    "gateway/harnesses/agent_config.py:pause_s": PACE,
    "gateway/harnesses/cli_agent.py:_MAX_PAUSE_S": SIZE,
    "gateway/harnesses/cli_agent.py:_IN_FLIGHT_PAUSE_S": PACE,
    "gateway/harnesses/clock.py:_LOOK_S": PACE,
    "gateway/harnesses/keeper.py:_TELL_TIME_S": PACE,
    "gateway/harnesses/trouble.py:MAX_BACKOFF_S": SIZE,
    "gateway/operations.py:WAIT_S": PACE,
    "gateway/operations.py:_UNAVAILABLE_PAUSE_S": PACE,
    "gateway/play.py:_QUICK_DEATH_S": SIZE,
    "gateway/processes.py:_PAUSE_S": PACE,
    "gateway/server.py:_REBIND_PAUSE_S": PACE,
    "gateway/session.py:RESULTS_WAIT_S": PACE,
    "gateway/session.py:NOT_NOW_PAUSE_S": PACE,
    "gateway/submits.py:DISK_PAUSE_S": PACE,
    "gateway/submits.py:LINGER_S": PACE,
    "gateway/suite/sweep.py:_ASK_AGAIN_S": PACE,
    "gateway/suite/sweep.py:_LOOK_S": PACE,
}


def is_number(node: ast.expr | None) -> bool:
    """A number other than nought, or a product of numbers; nought is what durations begin at and what does not wait."""
    if isinstance(node, ast.Tuple) and node.elts:
        return is_number(node.elts[-1])
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    value = node.value if isinstance(node, ast.Constant) else None
    return isinstance(value, int | float) and not isinstance(value, bool) and value != 0


def found_in(tree: ast.Module) -> Iterator[str]:
    """Names of durations with a value, and waits for a number of seconds that has no name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and is_number(node.value):
            yield from (
                each.id for each in node.targets if isinstance(each, ast.Name) and CONSTANT.fullmatch(each.id)
            )
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and is_number(node.value):
            if CONSTANT.fullmatch(node.target.id) or FIELD.fullmatch(node.target.id):
                yield node.target.id
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            positional = [*node.args.posonlyargs, *node.args.args]
            pairs = [*zip(reversed(positional), reversed(node.args.defaults), strict=False)]
            pairs += [
                (arg, each)
                for arg, each in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
                if each
            ]
            for arg, default in pairs:
                if FIELD.fullmatch(arg.arg) and is_number(default):
                    yield f"{node.name}({arg.arg})"
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func).rpartition(".")[2]
            given = [each.value for each in node.keywords if (each.arg or "").startswith("timeout")]
            given += node.args[-1:] if name in CALLS else []
            if any(map(is_number, given)):
                yield ast.unparse(node)


def collected() -> set[str]:
    found = set()
    for room, folder in ROOMS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(path.read_text())
            found |= {f"{room}/{path.relative_to(ROOT / folder)}:{name}" for name in found_in(tree)}
    return found


def test_every_duration_in_the_code_is_in_the_table_and_every_one_in_the_table_is_in_the_code() -> None:
    assert TIMEOUTS.keys() & NO_TIMEOUTS.keys() == set()
    assert collected() - TIMEOUTS.keys() - NO_TIMEOUTS.keys() == set(), "say which test lets it pass"
    assert (TIMEOUTS.keys() | NO_TIMEOUTS.keys()) - collected() == set(), "these are gone"


def test_every_test_that_the_table_names_is_there() -> None:
    for where, test in TIMEOUTS.items():
        path, _, name = test.partition("::")
        functions = {
            node.name
            for node in ast.parse((ROOT / path).read_text()).body
            if isinstance(node, ast.FunctionDef)
        }
        assert name in functions, f"{where}: {test}"


def table() -> str:
    """The timeouts in Markdown; a test's name says what happens when it passes."""
    lines = ["| timeout | in | what happens, tested |", "|---|---|---|"]
    for where, test in TIMEOUTS.items():
        path, _, name = where.rpartition(":")
        words = test.rpartition("::")[2].removeprefix("test_").replace("_", " ")
        lines.append(f"| `{name}` | `{path}` | {words} |")
    return "\n".join(lines) + "\n"


def test_the_document_lists_every_timeout() -> None:
    written = DOCUMENT.read_text()
    assert table() in written, "write it anew: python tests/unit/test_timeouts.py"


def test_a_wait_for_a_number_without_a_name_is_found() -> None:
    source = "A_S = 2 * 3.0\nB_S = 0.0\ndef f(x_s=1): wait_for(y, 2)\nclass C:\n    d_s: float = 1.0\nrun(timeout=3)\njoin()"
    assert set(found_in(ast.parse(source))) == {"A_S", "f(x_s)", "wait_for(y, 2)", "d_s", "run(timeout=3)"}


if __name__ == "__main__":
    before, _, rest = DOCUMENT.read_text().partition("| timeout |")
    DOCUMENT.write_text(before + table() + rest[rest.index("\n\n") + 1 :])
