"""Fixtures of the link tests: front processes, as the front's own tests start them."""

from tests.front.conftest import open_process, process_session

__all__ = ["open_process", "process_session"]
