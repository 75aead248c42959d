"""Code that every room of evopolicy shares: wire messages, keys, transport, bundles, trajectories, the catalogue.

It imports none of the other rooms and no simulator, so that an agent's host can install it alone.
"""

__version__ = "0.2.0"
