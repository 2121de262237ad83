"""Verdict of a demo on the streams of its cameras, and cameras that cannot be drawn. No session runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from iris_session.client.stream_meter import StreamMeasurement
from iris_session.cloud.frames import SourceError
from iris_session.demo import run
from iris_session.demo.demos import Demo, make_demo
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.session.config import SessionConfig


def judge(*warnings: str, restarts: int = 0, **values: Any) -> tuple[str, str]:
    """Return problems and notes of a demo whose observer has measured a stream with these values."""
    play = Demo("cloud", None, {}, (HeadsetSpec(name="eve", streams=("room",)),), ())
    measured = StreamMeasurement(**{"stream": "room", "frames": 30, **values})
    cameras = SimpleNamespace(list_warnings=lambda: list(warnings), restarts=restarts)
    session: Any = SimpleNamespace(processes=SimpleNamespace(cameras=cameras))
    report = HeadsetReport(name="eve", streams=(measured,))
    problems, notes = run._list_camera_faults(play, {"eve": report}, session)
    return "; ".join(problems), "; ".join(notes)


@pytest.mark.parametrize(
    ("values", "problem", "note"),
    [
        ({}, "", ""),
        ({"stream": "other"}, "eve: no frame of the stream 'room' came", ""),
        ({"frames": 0, "fault": "source", "detail": "no OpenGL here"}, "source: no OpenGL here", ""),
        ({"stale": True, "silent_s": 6.0}, "'room' is stale", ""),
        ({"fault": "no_depth", "detail": "camera front: no pixel"}, "'room' is no_depth: camera front: no pixel", ""),
        ({"restarts": 2}, "started again, 2 times", ""),
        ({"silent_s": 1.5, "fault": "slow", "detail": "3 of 10"}, "", "'room' is slow: 3 of 10"),
        ({"silent_s": 1.5, "fault": "source", "detail": "no frame", "stale": True}, "", "'room' is source: no frame"),
        ({"silent_s": 1.5, "stale": True}, "", "'room' is stale"),
    ],
)
def test_streams_that_are_missing_or_faulty_are_problems_and_late_ones_notes(
    values: dict[str, Any], problem: str, note: str
) -> None:
    problems, notes = judge(**values)
    assert (bool(problems), bool(notes)) == (bool(problem), bool(note))
    assert problem in problems
    assert note in notes


def test_warnings_of_camera_processes_are_problems() -> None:
    assert judge("the camera process of 'room' hangs") == ("the camera process of 'room' hangs", "")


def test_cameras_that_cannot_be_drawn_end_a_demo_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(tmp_path / "missing.json"))  # libEGL finds no driver
    monkeypatch.setenv("MUJOCO_GL", "disable")  # as commands set it
    play = dataclasses.replace(make_demo("cloud"), model=None)  # a session could not be made of it
    with pytest.raises(SourceError) as caught:
        run.run_demo(play, SessionConfig(record=False))
    assert str(caught.value).startswith("demo cloud draws what its cameras see: no OpenGL here (")
    assert "libegl1 libgl1-mesa-dri" in str(caught.value)
    assert "MUJOCO_GL=osmesa" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_handover_is_an_episode_with_success() -> None:
    posted: list[Any] = []
    view = SimpleNamespace(handovers=[SimpleNamespace(object="hammer", at_s=1.0)])
    core = SimpleNamespace(world=SimpleNamespace(view=lambda: SimpleNamespace(sim_time=0.0)))
    session: Any = SimpleNamespace(
        clock=iter((2_000_000_000, 4_000_000_000)).__next__,
        post=posted.append,
        stepper=SimpleNamespace(view=view, core=core),
    )
    tracker = run._GoalTracker(Demo("handover", None, {}, (), ("hammer",)), session)
    tracker.update(lambda: False)
    assert not posted
    tracker.update(lambda: True)
    assert [one.action for one in posted] == ["start"], "a handover of an earlier attempt does not count"
    view.handovers.append(SimpleNamespace(object="hammer", at_s=3.0))
    tracker.update(lambda: True)
    tracker.update(lambda: True)
    assert [one.action for one in posted] == ["start", "success"]
    tracker.restart()
    tracker.update(lambda: True)
    assert [one.action for one in posted[2:]] == ["discard", "discard", "start"]
