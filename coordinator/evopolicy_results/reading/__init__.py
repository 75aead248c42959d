"""Reads run directories into typed records."""
