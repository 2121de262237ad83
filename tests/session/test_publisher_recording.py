"""The recording of a publisher, by a recorder in a process."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session import ResumeError, SceneBuilder, ScenePublisher, Session, SessionConfig
from iris_session.recording import Recording
from iris_session.session.resume import find_note_path
from iris_session.session.verification import verify_recording


@pytest.mark.e2e
def test_recording_of_a_publisher_verifies_and_cannot_be_resumed(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, web=False, record=path)
    scene = SceneBuilder("bench")
    scene.add_box("box", half_size=(0.1, 0.1, 0.1), movable=True, position=(1.0, 0.0, 0.0))
    with ScenePublisher(scene, config) as session:
        session.publish(1.0)
    assert session.close(), session.recording_fault
    report = verify_recording(path)
    assert (report.ok, report.unverified_steps) == (True, 0), report
    with Recording.open(path) as recording:
        assert recording.header.recording_class == "open"
        assert [body.name for body in recording.header.bodies] == ["box"]
    with pytest.raises(ResumeError, match="'open'"):
        Session(config=SessionConfig(resume=path))
    assert not find_note_path(path).exists(), "what nobody can go on from needs none"
