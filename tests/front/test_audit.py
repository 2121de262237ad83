"""Audit entries: the first at once, the others counted, within bounds, with an exact sum."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from iris_session.front.audit import MAX_PENDING, PERIOD_NS, AuditTrail
from iris_session.protocol.entries import HOST, Audit, Entry


class Trail:
    def __init__(self) -> None:
        self.told: list[Entry] = []
        self.trail = AuditTrail(self._offer)

    def _offer(self, entry: Entry) -> bool:
        self.told.append(entry)
        return True

    @property
    def audits(self) -> list[Audit]:
        messages = [entry.message for entry in self.told]
        return [message for message in messages if isinstance(message, Audit)]


def test_first_audit_is_sent_at_once_and_others_once_a_second() -> None:
    t = Trail()
    for i in range(5):
        t.trail.record("code_refused", i, address="10.0.0.9", detail=str(i))
    assert t.told == [Entry(HOST, HOST, 0, Audit("code_refused", "", "", "10.0.0.9", "0", 1))]
    t.trail.tick(PERIOD_NS - 1)
    assert len(t.told) == 1
    t.trail.tick(PERIOD_NS)
    assert t.audits[1] == Audit("code_refused", "", "", "10.0.0.9", "4", 4)
    t.trail.tick(2 * PERIOD_NS)
    t.trail.tick(3 * PERIOD_NS)
    assert len(t.told) == 2
    t.trail.record("code_refused", 3 * PERIOD_NS, address="10.0.0.9")
    assert len(t.told) == 3, "after a quiet second the next is a first one again"


@given(
    st.lists(st.tuples(st.sampled_from(["a", "b"]), st.integers(0, 60), st.integers(0, 300_000_000)), max_size=300),
)
def test_audits_are_bounded_and_their_sum_is_exact(steps: list[tuple[str, int, int]]) -> None:
    t = Trail()
    now = 0
    for kind, address, dt in steps:
        now += dt
        t.trail.tick(now)
        t.trail.record(kind, now, address=str(address))
    for second in (1, 2):
        t.trail.tick(now + second * PERIOD_NS)
    assert sum(audit.count for audit in t.audits) == len(steps)
    seconds = now // PERIOD_NS + 2
    assert len(t.told) <= (MAX_PENDING + 2) * 2 * seconds
