"""Errors of the control room. Each message is one line that says what would have been right."""

from __future__ import annotations


class ControlError(ValueError):
    """A robot, object or configuration that control cannot drive as described."""
