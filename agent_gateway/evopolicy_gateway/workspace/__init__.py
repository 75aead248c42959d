"""An agent's workspace before the agent starts."""
