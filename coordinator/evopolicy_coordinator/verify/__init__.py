"""`evopolicy verify`: finished episodes played again and compared."""
