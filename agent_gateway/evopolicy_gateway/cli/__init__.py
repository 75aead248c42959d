"""The `evopolicy` and `evopolicy-gateway` commands."""
