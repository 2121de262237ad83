"""Verdict of a demo on the streams of its cameras, and cameras that cannot be drawn. No session runs."""

from __future__ import annotations

import dataclasses
import re
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


def test_streams_that_came_to_the_end_are_no_problem() -> None:
    assert judge() == ("", "")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"stream": "other"}, "eve: no frame of the stream 'room' came$"),
        ({"frames": 0, "fault": "source", "detail": "no OpenGL here"}, "'room' came, source: no OpenGL here$"),
        ({"stale": True, "silent_s": 6.0}, "eve: the stream 'room' is stale, newest frame 6.0 s ago$"),
        ({"silent_s": 6.0}, "eve: the stream 'room' is stale, newest frame 6.0 s ago$"),
        ({"fault": "no_depth", "detail": "camera front: no pixel"}, "'room' is no_depth: camera front: no pixel, "),
        ({"fault": "source", "detail": "no frame for 7 s", "silent_s": 7.0}, "'room' is source: no frame for 7 s, "),
        ({"restarts": 2}, "started again, 2 times$"),
    ],
)
def test_streams_that_are_missing_stale_or_faulty_are_problems(values: dict[str, Any], text: str) -> None:
    problems, notes = judge(**values)
    assert re.search(text, problems), problems
    assert notes == ""


def test_warnings_of_camera_processes_are_problems() -> None:
    assert judge("the camera process of 'room' hangs") == ("the camera process of 'room' hangs", "")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"fault": "slow", "detail": "3 of 10"}, "'room' is slow: 3 of 10, newest frame 1.5 s ago$"),
        ({"fault": "source", "detail": "no frame for 1 s", "stale": True}, "'room' is source: no frame for 1 s, "),
        ({"stale": True}, "'room' is stale, newest frame 1.5 s ago$"),
    ],
)
def test_cameras_whose_frames_come_late_are_noted(values: dict[str, Any], text: str) -> None:
    problems, notes = judge(silent_s=1.5, **values)
    assert problems == ""
    assert re.search(text, notes), notes


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
