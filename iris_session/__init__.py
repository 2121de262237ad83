"""Public API of iris-session: `Session`, `SessionConfig`, `Client` and the errors. Nothing else is public."""
