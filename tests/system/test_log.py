"""Logging of our processes: one line per record on standard error, level from `IRIS_LOG`."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from iris_session.system.log import ROOTS, RepetitionFilter, configure_logging


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


def test_a_repeated_message_does_not_fill_the_log() -> None:
    limit = RepetitionFilter()

    def write(text: str, at_s: float) -> bool:
        record = logging.makeLogRecord({"msg": text, "args": (at_s,)})
        record.created = at_s
        return limit.filter(record)

    assert sum(write("closed %g", 100.0 + n * 1e-3) for n in range(1000)) == RepetitionFilter.BURST
    assert write("another %g", 101.0)
    assert write("closed %g", 101.0 + RepetitionFilter.PERIOD_S)
