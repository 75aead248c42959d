"""The coordinator: owns the budget ledger, the hidden splits, the job queue, all checkpoints and all results."""
