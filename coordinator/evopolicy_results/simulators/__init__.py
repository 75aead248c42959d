"""Signs that an agent's code simulates its environment, for runs whose rules forbid it. A signal, never a verdict."""
