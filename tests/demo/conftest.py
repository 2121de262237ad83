"""Fixtures of the demo tests: models of real robots, shared with the tests of physics."""

from tests.physics.conftest import aloha, data_dir, handover, iiwa

__all__ = ["aloha", "data_dir", "handover", "iiwa"]
