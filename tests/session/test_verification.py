"""The core of a recording: the solver of inverse kinematics is the one that it was made with."""

from __future__ import annotations

import sys

import msgspec
import pytest

from iris_session.control.config import SOLVER_MINK, SOLVER_NUMPY
from iris_session.recording import CLOSED, SessionHeader
from iris_session.session.core import SessionCore
from iris_session.session.verification import ReplayCore
from tests.replay.support import make_header
from tests.session.play import make_core, play

STEPS = 100


def header_of(core: SessionCore) -> SessionHeader:
    return make_header(core, CLOSED)


def replay(header: SessionHeader) -> list[bytes]:
    """Return the digests of the scripted session, taken again."""
    core = ReplayCore(header, {}.__getitem__).core
    return play(core, 0, STEPS)


def test_a_session_without_mink_is_verified_where_mink_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mink", None)
    core = make_core()
    header = header_of(core)
    digests = play(core, 0, STEPS)
    assert core.config.control.solver == SOLVER_NUMPY
    assert replay(header) == digests
    monkeypatch.undo()
    assert replay(header) == digests
    with_mink = make_core()
    assert with_mink.config.control.solver == SOLVER_MINK
    assert play(with_mink, 0, STEPS) != digests  # the last bits differ
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "mink", None)
        with pytest.raises(ImportError, match=r"iris-session\[mink\]"):
            replay(header_of(with_mink))


def test_a_recording_that_names_no_solver_was_made_with_mink(monkeypatch: pytest.MonkeyPatch) -> None:
    core = make_core()
    config = msgspec.msgpack.decode(header_of(core).config)
    del config["control"]["solver"]
    header = msgspec.structs.replace(header_of(core), config=msgspec.msgpack.encode(config))
    assert replay(header) == play(core, 0, STEPS)
    monkeypatch.setitem(sys.modules, "mink", None)
    with pytest.raises(ImportError, match=r"iris-session\[mink\]"):
        replay(header)


@pytest.mark.parametrize("name", ["target_grippers", "proximity_per_joint", "proximity_stopped"])
def test_what_a_recording_made_before_does_not_name_was_off(name: str) -> None:
    config = msgspec.msgpack.decode(header_of(make_core()).config)
    del config["control"][name]
    header = msgspec.structs.replace(header_of(make_core()), config=msgspec.msgpack.encode(config))
    assert not getattr(ReplayCore(header, {}.__getitem__).core.config.control, name)
