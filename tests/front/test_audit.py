"""Audit entries: the first at once, the others counted, within bounds, with an exact sum."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from iris_session.front.audit import MAX_PENDING, PERIOD_NS, AuditTrail
from iris_session.protocol.entries import Audit, Entry


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
