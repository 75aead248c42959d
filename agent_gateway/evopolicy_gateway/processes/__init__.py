"""Processes that the gateway starts and ends, their messages to each other, their logs, and an agent's clock."""
