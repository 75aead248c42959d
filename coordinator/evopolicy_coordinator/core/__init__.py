"""The coordinator's pure core: budget ledger, scheduler, run life cycle and finalisation as one state machine.

    core, effects = Core.load(settings, snapshot, now)
    effects = core.handle(event, now)
    effects = core.handle_deadline(now)         # when now >= core.next_deadline()

The core has no clock, random numbers, disk, log or await: `now` and randomness come in, ordered effects and the next
deadline go out.

Start with `transcripts/submit.txt` and `transcripts/result_report.txt`. They show the core's input, the rules that act,
and the effects for the shell. Then read `machine`, whose tables map each event, piece of news and deadline to its
rules, `contract`, its input and output, and `tables`, the data of the rules. The folders of rules build on each other
in this order:
`isolation` (conflicts on a kernel), `leasing` (from the queue to a worker and back), `agents` (permits and precedence),
`workers` (requests of workers), `runs`.

Contract with the shell
-----------------------
*Time.* `now` is Unix time in seconds, read once when the core starts and then advanced by a monotonic clock: during one
core's life it never goes back, even if the wall clock is set. The shell calls `handle_deadline` as soon as it can after
`next_deadline()`. While leases are out, the core requests a call at least every second. A late call shows that the loop
was blocked; then no lease expires for one time to live.

*Order and durability.* See `contract.effects`: strictly in order, and every `Persist` is durable before the effects
after it. The shell may handle many events, then write all their `Persist`s in one transaction, then carry out the other
effects. When a `Persist` fails, the shell carries out no effect after it, discards the core, and loads a new one from
the store (incarnation + 1). Changes that were not persisted did not happen, and no reply has reported them.

*Start.* Increment the incarnation durably, read the `Snapshot` (its docstring lists the contents), call `Core.load`,
carry out the effects that it returns (they conclude groups that were complete but not concluded), and serve.

*Ids and secrets.* The shell makes run ids, capabilities, run secrets, sessions, evaluation ids and stimulus ids, and
passes them in events. The core derives the rest: group and job ids from run, submit and index; lease ids from job and
attempt; policy seeds by HMAC (`leasing.jobs`). Attempt numbers also grow over restarts, since they start at
(incarnation − 1) · 1,000,000.

*Tokens.* The shell checks tokens before it raises an event. `core.state.capabilities` has the
tokens of all runs, finished ones too. The core checks sessions: it answers a request with an unknown session with
`Refused("unknown_worker")`. The worker then registers again, sends a heartbeat with all leases that it holds, and
continues.

*Stopped leases.* A worker learns of leases to stop (cancelled, played elsewhere) from the first of these
replies: its waiting lease poll, a heartbeat whose reply is delayed (`wait_s`), or its next heartbeat.

*Long polls* (leases, results, evaluations, waiting for a run) are soft state of the core with deadlines. Each event
with a `request` is answered by exactly one effect that names it. A second lease poll of a worker answers its first one
with no leases.

*Bundles and blobs.* Before the shell passes in a `Submit`, it has stored the submit's bundle; before a `ReportResults`,
the blobs that its outcomes name. Inline trajectories are part of the outcome. The store may keep them inline or as
blobs, as long as digests stay the same.

*Status* is read, not an event: `core.status(now, words)` returns workers, runs, stalls, episodes done and their rate as
fields of a `StatusReply`.

*Memory.* A core holds open work only: for each open group of episodes their returns and order of arrival, for each
unfinished run its submits without their episodes, for each finished run its key and capability. `ReadResults` and
`ReadEvaluation` read outcomes from the store.
"""

from __future__ import annotations
