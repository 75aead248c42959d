"""`evopolicy rescore`: plays finished runs' checkpoints on further hidden cases."""
