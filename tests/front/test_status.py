"""The status report of a front, with a scripted authority."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from iris_session.front.status import list_device_warnings
from iris_session.protocol.client_messages import Hello, Observation
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import Join
from iris_session.protocol.status import AlignmentReport, ClientReport, GetStatus, ParticipantReport, StatusReport
from tests.front.harness import N_BODIES, FrontSession, RawClient

MS = 1_000_000


def half(*people: ParticipantReport, **fields: object) -> StatusReport:
    """Return the authority's half of the report."""
    return StatusReport(0, "", "", 1, participants=people, **fields)  # type: ignore[arg-type]


STILL = np.tile([0.0, 0, 0, 1, 0, 0, 0], (N_BODIES, 1))


def row(participant: str, **fields: object) -> ParticipantReport:
    return ParticipantReport(participant, "Ann", "operator", True, **fields)  # type: ignore[arg-type]


def anything(_: StatusReport) -> bool:
    return True


def ask(
    session: FrontSession, client: RawClient, until: Callable[[StatusReport], bool] = anything, *, moving: bool = False
) -> StatusReport:
    """Request the status a few times a second until the answer is as wanted. `moving`: send a state with every step."""
    steps = 0

    def wanted() -> bool:
        nonlocal steps
        if moving:
            session.send_state(STILL)
        if steps % 300 == 0:
            client.send(GetStatus(1 + steps))
        steps += 1
        got = client.got(StatusReport)
        del client.inbox[:]
        return bool(got) and until(got[-1]) and not answers.append(got[-1])

    answers: list[StatusReport] = []
    session.pump(wanted, "a status as wanted")
    return answers[-1]


def test_both_halves_make_one_report(open_session: Callable[..., FrontSession]) -> None:
    session = open_session(anchors={"table": IDENTITY})
    client = session.client()
    welcome = client.join(software="quest 1.0", devices=("head",))
    theirs = row(welcome.participant_id, holds=("left",), alignment_report=AlignmentReport(version=7))
    session.process.link.send_report(half(theirs, late_share=0.25, drops={"journal_rows": 3}))
    seen = Pose((0.5, 0.0, 0.0), IDENTITY.q)
    client.send(Observation("table", "qr", seen, session.process.link.now_ns, 1, 1))
    client.send(ClientReport(1.5, 7.0, 30, 10, 2.5, 1000.0))
    report = ask(
        session,
        client,
        lambda r: (
            bool(r.participants)
            and r.participants[0].reported
            and r.step_to_publish is not None
            and getattr(r.participants[0].alignment_report, "observations", 0) == 1
        ),
        moving=True,
    )
    assert (report.session_name, report.late_share, report.connections) == ("test", 0.25, 1)
    assert report.drops["journal_rows"] == 3
    assert 0 <= report.authority_silent_ns < 60_000 * MS
    (ann,) = report.participants
    assert ann.holds == ("left",)
    assert ann.software == "quest 1.0"
    assert ann.address.startswith("127.0.0.1:")
    assert ann.state_age is not None
    assert (ann.state_age.p50, ann.state_age.p99, ann.missed_share, ann.rtt_ms) == (1.5, 7.0, 0.25, 2.5)
    assert ann.heard_ns >= 0
    assert ann.lost == ""
    assert ann.alignment_report is not None
    assert ann.alignment_report.version == 7


def test_a_headset_that_will_fail_is_warned_about(session: FrontSession) -> None:
    """Before it dies in an episode: by battery, heat and dropped frames, and no more once it is well."""
    client = session.client()
    welcome = client.join(name="Ann")
    session.process.link.send_report(half(row(welcome.participant_id)))
    good = ClientReport(1.0, 2.0, 60, display_hz=72.0, battery=0.8, thermal="nominal", dropped_frames=3)
    bad = replace(good, battery=0.09, thermal="hot", dropped_frames=30)
    for sent, count in ((bad, 3), (replace(bad, charging=True), 2), (good, 0)):
        client.send(sent)
        wanted = (sent.battery, sent.charging)

        def shows(report: StatusReport, wanted: tuple[float, bool] = wanted) -> bool:
            return [(p.battery, p.charging) for p in report.participants] == [wanted]

        report = ask(session, client, shows)
        (ann,) = report.participants
        assert (ann.charging, ann.thermal, ann.dropped_frames) == (sent.charging, sent.thermal, sent.dropped_frames)
        assert len([text for text in report.warnings if text.startswith("Ann: ")]) == count
    gone = replace(ann, connected=False, battery=0.01)
    assert list_device_warnings(gone) == []
    assert list_device_warnings(replace(ann, display_hz=0.0, dropped_frames=50, battery=-1.0)) == []


def test_client_can_request_status_before_admission(session: FrontSession) -> None:
    """A stalled authority admits no client; then the status is needed most."""
    session.admits = False
    client = session.client()
    client.send(Hello("observer", "doctor", secret=client.secret))
    session.wait_entries(Join)
    client.send(GetStatus(7))
    report = client.wait_for(StatusReport)
    assert report.request_id == 7


def test_reason_of_a_disconnect_is_kept(session: FrontSession) -> None:
    ann, bob = session.client(), session.client()
    welcome = ann.join()
    bob.join(name="Bob")
    session.process.link.send_report(half(row(welcome.participant_id)))
    ann.close()
    report = ask(session, bob, lambda r: bool(r.participants) and not r.participants[0].connected)
    assert report.participants[0].lost == "closed"
