"""Live anchors through a front: from samples and observations to entries, and events back into it."""

from __future__ import annotations

from collections.abc import Callable

from iris_session.protocol.client_messages import Observation, Sample, Samples
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm, AlignmentProposal
from iris_session.protocol.server_messages import AnchorMoved, Event
from iris_session.protocol.steps import Decision
from tests.front.harness import FrontSession


def test_moved_anchor_realigns_observers_and_bump_is_an_alarm(
    open_session: Callable[..., FrontSession],
) -> None:
    session = open_session(anchors={"table": Pose((1.0, 0.0, 0.8), IDENTITY.q)})
    client = session.client()
    client.join(devices=("head",))

    def proposed(x: float) -> bool:
        proposals = [e.message for e in session.entries if isinstance(e.message, AlignmentProposal)]
        return any(not p.refused and abs(p.T_world_tracking.p[0] - x) < 0.01 for p in proposals)

    def head(x: float, seq: int) -> Sample:
        pose = Pose((x, 0.0, 0.3), IDENTITY.q)
        return Sample("head", "pose", seq, 1000 * seq, 1, 1, 0, pose=pose)

    for i in range(8):
        client.send(Samples((head(0.5, i),)))
        client.send(Observation("table", "qr", Pose((0.5, 0.0, -0.2), IDENTITY.q), 1000 * i, 1, i))
    session.pump(lambda: proposed(0.5), "a proposal")
    session.event_seq += 1
    body = AnchorMoved("table", Pose((3.0, 0.0, 0.8), IDENTITY.q))
    session.once(Decision((), events=(Event(session.event_seq, session.step, 0, body),)))
    session.pump(lambda: proposed(2.5), "a proposal to the new place")
    client.send(head(1.5, 9))
    (alarm,) = session.wait_entries(AlignmentAlarm)
    assert alarm.connection == 1
    assert alarm.message.kind == "jump"  # type: ignore[union-attr]
