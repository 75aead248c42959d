"""The relay for model calls: a process of its own between an agent and the API of its model.

Rules:
- Only the relay has the provider's key. The agent has a token that the relay alone accepts.
- The relay counts requests and tokens at the wire, and writes each request to its ledger before the end of the answer
  reaches the agent. A kill of any process loses at most the requests in flight.
- A request beyond the run's limits is refused in the provider's own form, and the run ends. Each request in flight
  reserves the most that it may use.
- Answers pass on as they come, and are read to their end when the agent has gone. A stream that would report no usage
  is asked for it, and the added chunk is removed.
- Requests are hostile: sizes, times, headers and paths are bounded, one bound holds for all bytes in flight, and each
  request to the provider is built anew from what was read of it.

`usage`, `answers`, `requests`, `apis`, and `limits` are pure; `ledger` and `service` do the I/O.

LiteLLM was considered and not used. It translates between APIs, reads and writes whole requests, and brings a large set
of dependencies into the one process that holds the key; the relay needs none of that, only bytes passed on and a few
counts read.
"""
