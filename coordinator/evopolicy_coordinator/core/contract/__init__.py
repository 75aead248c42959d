"""The contract between the core and its shell: events in, effects out, codes of refusals, stored rows, and settings."""
