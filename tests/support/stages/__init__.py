"""Stand-ins for a cluster around an agent, its CLI, or a sweep under test: gateways, a model API, runs."""
