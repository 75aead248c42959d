"""An agent's way of working: its edits, the structure of its policies, its use of feedback."""
