"""The coordinator: owns the budget ledger, the hidden splits, the queue, every checkpoint and every result."""
