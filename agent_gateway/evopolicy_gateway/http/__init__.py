"""The agent's HTTP service: `/info`, `/task`, `/submit`."""
