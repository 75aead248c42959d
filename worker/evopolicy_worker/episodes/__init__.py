"""Episodes: what the environment's process of a slot runs."""
