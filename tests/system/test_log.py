"""Logging of our processes: one line per record on standard error, level from `IRIS_LOG`."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from iris_session.system.log import ROOTS, configure_logging


@pytest.fixture(autouse=True)
def restored_loggers() -> Iterator[None]:
    before = {name: (logging.getLogger(name).level, list(logging.getLogger(name).handlers)) for name in ROOTS}
    yield
    for name, (level, handlers) in before.items():
        logging.getLogger(name).setLevel(level)
        logging.getLogger(name).handlers[:] = handlers


def test_warnings_are_one_line_on_standard_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("IRIS_LOG", raising=False)
    configure_logging()
    configure_logging()
    logging.getLogger("iris_session.session").warning("front restarted after %g s", 1.5)
    logging.getLogger("iris_session.session").info("not shown")
    assert capsys.readouterr().err == "WARNING iris_session.session: front restarted after 1.5 s\n"


@pytest.mark.parametrize(("name", "level"), [("debug", 10), ("", 30), ("loud", 30)])
def test_level_is_read_from_the_environment(monkeypatch: pytest.MonkeyPatch, name: str, level: int) -> None:
    monkeypatch.setenv("IRIS_LOG", name)
    configure_logging()
    assert logging.getLogger("iris_session").level == level
