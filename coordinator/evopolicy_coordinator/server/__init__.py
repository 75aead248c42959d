"""The running coordinator around its core: requests in, effects out."""
