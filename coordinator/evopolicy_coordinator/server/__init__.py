"""The coordinator's shell around the core: requests in, effects out."""
