"""The coordinator's pure core: ledger, scheduler, run life-cycle and finalisation as one state machine.

    core, effects = Core.load(settings, snapshot, now)
    effects = core.handle(event, now)
    effects = core.handle_deadline(now)         # when now >= core.next_deadline()
    core.validate()                             # raises InvariantError with a trace; cheap enough for tests only

No clock, RNG, disk, log or await in here: `now` and randomness come in, ordered effects and the next deadline go out.

Where to begin: `transcripts/submit.txt` and `transcripts/result_report.txt` show what the core is told, which rules act and what
it asks of its shell. Then `machine`, whose tables say who takes which event, news and deadline; `model` and `state`, what the
rules work on; and the rules, each folder building on those before it: `isolation` (who may be on which kernel), `leasing` (from
the queue to a worker and back), `agents` (permits, and who goes first), `workers` (what workers ask), `runs`.

Contract with the shell
-----------------------
*Time.* `now` is Unix time in seconds, read once at the core's start and advanced by a monotonic clock since: it never goes
back during one core's life, whatever is done to the wall clock. The shell calls `handle_deadline` as soon as it can
after `next_deadline()`. The core asks for a tick at least every second while leases are out and sees from its
lateness when the loop stood still; then it lets nothing expire for one time to live.

*Order and durability.* See `effects`: strictly in order, every `Persist` durable before what follows it. The shell may
handle many events, then write all their `Persist`s in one transaction, then carry out the rest. When a `Persist` fails,
nothing after it is carried out, the core is discarded, and a new one is loaded from the store (incarnation + 1): what was
not persisted did not happen, and no one was told.

*Start.* Increment the incarnation durably, read the `Snapshot` (see there what it must hold), `Core.load`, carry out the
effects that it returns (they finish what was complete but not yet concluded), and serve.

*Ids and secrets* are made by the shell and come in through events: run ids, capabilities, run secrets, sessions,
evaluation ids, stimulus ids. The core derives the rest: group and job ids from run, submit and index; lease ids from job
and attempt; policy seeds by HMAC (`seeds`). Attempt numbers grow over restarts too, since they start at
(incarnation − 1) · 1,000,000.

*Tokens* are the shell's to check, before it raises an event; `core.capability(run)` gives a run's (finished runs
too), `core.worker_of(session)` the worker whose session it is.
Sessions are the core's: a request with an unknown one is answered `Refused("unknown_worker")`, upon which the worker
registers again, beats with all that it holds, and goes on.

*What a worker is to stop* (preempted, cancelled, played elsewhere) is told in whichever of its answers comes first: the
waiting lease poll, a heartbeat that is held back (`wait_s`), or the next heartbeat.

*Long polls* (leases, results, evaluations, waiting for a run) are kept in the core, as soft state with deadlines:
each event with a `request` is answered by exactly one effect that names it. A second lease poll of a worker answers
its first with no leases.

*Bundles and blobs.* The shell makes sure that a submit's bundle is stored before it hands a `Submit` in, and that the
blobs an outcome names are stored before it hands a `ReportResults` in. Inline trajectories travel in the outcome; whether a
row keeps them inline or as a blob is the store's business, as long as digests stay.

*Status* is read, not an event: `core.status(now, words)` gives workers, runs, stalls, episodes done and their rate as the parts of
a `StatusReply`. `core.trace(key)` tells what happened to a job, lease, run or worker, as far back as is kept.

*Memory.* A core holds open work only: for each open group of episodes their returns and order of arrival, for each
unfinished run its submits without their episodes, for each finished run its key and capability. Outcomes are read from
the store by `ReadResults` and `ReadEvaluation`.
"""

from __future__ import annotations
