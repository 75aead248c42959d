"""The interface of every harness: how an agent is configured, started and prompted, and how its usage is counted."""
