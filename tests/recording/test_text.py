"""Text lines, and properties that a re-simulation must share with the recording."""

from __future__ import annotations

from iris_session.protocol.common import Alignment, Denial, Lease, Pose
from iris_session.protocol.server_messages import AlignmentChanged, Event, Gap, LeaseChanged
from iris_session.recording import environment as versions
from iris_session.recording.messages import DenialRecord
from iris_session.recording.writer import describe_denial, describe_event, describe_session
from tests.recording.support import make_header


def test_event_text_has_kind_and_non_empty_fields() -> None:
    line = describe_event(Event(3, 1, 2, LeaseChanged(Lease("left", "robot", "exclusive", "p1", 4), "acquired")))
    assert line.level == "INFO"
    assert line.text.startswith("#3 lease_changed lease.target=left lease.kind=robot")
    assert "queue" not in line.text
    pose = Pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    aligned = AlignmentChanged("p1", Alignment(2, "measured", pose, covariance=(0.5,) * 36))
    text = describe_event(Event(4, 1, 2, aligned)).text
    assert "alignment.kind=measured" in text
    assert "0.5" not in text, "36 numbers are for the data, not for people"
    assert describe_event(Event(5, 1, 2, Gap("recording", 7))).level == "ERROR"


def test_denial_text_has_holder_and_advice() -> None:
    line = describe_denial(DenialRecord(1, 2, 3, Denial("role", "observers cannot drive", "join as operator")))
    assert line == ("WARN", "connection 3: role: observers cannot drive; join as operator")


def test_session_page_names_class_and_versions() -> None:
    page = describe_session(make_header("open", {"mujoco": "4.0.0"}))
    assert "**open**" in page
    assert "| mujoco | 4.0.0 |" in page


def test_versions_here_equal_versions_here() -> None:
    here = versions.describe_environment()
    assert here["numpy"] != "absent"
    assert versions.compare_environment(here) == []
    other = {**here, "numpy": "1.0", "gone": "2"}
    assert [line.split(":")[0] for line in versions.compare_environment(other)] == ["gone", "numpy"]
