"""Impaired networks in user space: a proxy in front of a session with latency, loss and outages by profile."""
