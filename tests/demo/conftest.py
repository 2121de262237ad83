"""Fixtures of the demo tests: models of real robots, shared with the tests of physics."""

from tests.physics.conftest import aloha, handover, panda

__all__ = ["aloha", "handover", "panda"]
