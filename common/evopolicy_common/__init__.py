"""What every room of evopolicy shares: wire messages, keys, transport, bundles, trajectories, the catalogue.

Imports none of the other rooms and no simulator, so that an agent's host can install it alone.
"""

__version__ = "0.1.0"
PROTOCOL_VERSION = "v2.0-draft"
"""The agent-facing protocol, as `/info` and `run.json` name it."""
