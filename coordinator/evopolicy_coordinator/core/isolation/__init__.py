"""Keeps hidden episodes and agents on different kernels, since a kernel's counters reveal one's activity to the other.

docs/explanation/hidden-episodes.md has the rules. `occupancies` says how long a lease occupies a kernel, `conflicts`
lists the occupants of a kernel and says which exclude each other. The folder `agents` has the permits of agents and the
order of precedence.

The work that may begin on a kernel, for a case set and its relatives. Several states may hold; each forbids its part.

| state | hidden lease | train lease | permit | ends |
|---|---|---|---|---|
| `agent`: a permit is held | no | yes | yes | `CloseRun`, cancellation, an operator's word |
| `asked`: a permit is requested | no | yes | yes | granted, or not repeated |
| `train`: a train lease | no | yes | yes | its occupancy is gone |
| hidden: a hidden lease | yes | no | no | its occupancy is gone |
| reserved for hidden jobs | yes, also if `asked` | beside an `agent` | no | all are played, or nobody there can |
| `kernel`: it is not known | no | if no kernel forbids it | if no kernel forbids it | the worker registers anew |

An occupancy is the place of a lease on a kernel:

| state | next |
|---|---|
| leased: granted, or adopted after a restart | gone, by its result |
| | gone, by a heartbeat after its arrival that does not name it |
| | lingering: the coordinator has given it up, such as after silence |
| lingering, also all that a known worker may play after a restart | gone, by a heartbeat of its kernel and machine |
| | gone, after `silent_bar_s` of silence |
"""
