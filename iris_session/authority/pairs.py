"""Pairs of headsets that are *unverified*: one has aligned by an anchor that the other saw last before that.

The anchor may have been moved in between. Each headset then agrees with what it saw, and only a glance of the other one
tells. It is asked for that, and begins no engagement until then. A pair is verified when both were looking at one
anchor at the same time, or each in turn without a contradiction: the times from first to last look overlap. A look that
agrees costs no glance, nor does a reconnection with the same tracking frame.

Those who cannot drive make no other glance: an observer must not hold the robots of others. `AlignmentProposal.looks`
says what a headset has looked at; `alignment` keeps it in `Participant.looks` while an alignment rests on it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from iris_session.authority import alignment
from iris_session.authority.context import Context
from iris_session.authority.state import NO_CONNECTION, Participant
from iris_session.protocol.entries import AlignmentProposal, AnchorLooks
from iris_session.protocol.names import AlignmentDoubt, Role
from iris_session.protocol.status import UnverifiedReport

#: Pairs in a report: of 64 people there are 4,032.
MAX_REPORTED: Final = 64


def process_proposal(ctx: Context, p: Participant, m: AlignmentProposal) -> None:
    """Process a proposal, and verify the pairs of `p` anew if it says that something was looked at."""
    before = p.looks
    alignment.process_proposal(ctx, p, m)
    if p.looks is before:
        return
    for moved in m.moved:
        if not before or moved in before:  # once
            doubt_anchor(ctx, p, moved, before.get(moved))
    for other in ctx.state.participants.values():
        if other.doubt == AlignmentDoubt.UNVERIFIED or find_unverified_anchor(other, p):
            _verify_participant(ctx, other)
    _verify_participant(ctx, p)


def check_pairs(ctx: Context) -> None:
    """Compare everybody with everybody once per `age_check_ns`: people come back, leave, or get another role."""
    if not ctx.config.verify_pairs:
        return
    for p in ctx.state.participants.values():
        if p.looks and ctx.now_ns >= p.pairs_due_ns:
            p.pairs_due_ns = ctx.now_ns + ctx.config.age_check_ns
            _verify_participant(ctx, p)


def find_unverified_anchor(p: Participant, other: Participant) -> str:
    """Return the anchor at which `p` is to glance because `other` has aligned by it since, empty for a verified
    pair, and for one that shares no anchor.
    """
    found: tuple[int, str] | None = None
    for anchor_id, looks in p.looks.items():
        others = other.looks.get(anchor_id)
        if others is None or p is other:
            continue
        if looks.first_ns <= others.last_ns and others.first_ns <= looks.last_ns:
            return ""
        if looks.last_ns < others.first_ns:
            found = max(found or (0, anchor_id), (others.last_ns, anchor_id))
    return "" if found is None else found[1]


def doubt_anchor(ctx: Context, p: Participant, anchor_id: str, known: AnchorLooks | None) -> None:
    """Doubt the alignments that rest on nothing but an anchor which was moved, as `p` sees beside others.

    One that began before the last look of `p` that agreed (`known`) rests on its old place, and stays.
    """
    for other in ctx.state.participants.values():
        looks = other.looks.get(anchor_id)
        if other is p or looks is None or len(other.looks) > 1 or (known and looks.first_ns <= known.last_ns):
            continue
        others = " or ".join(f"'{name}'" for name in p.looks if name != anchor_id) or "another one"
        text = f"sheet {anchor_id} was moved, as {p.name} sees it: look at sheet {others}"
        alignment.doubt_alignment(ctx, other, AlignmentDoubt.CONTRADICTED, text)


def build_unverified_reports(ctx: Context) -> tuple[UnverifiedReport, ...]:
    """Return the pairs that are unverified, at most `MAX_REPORTED`."""
    reports: list[UnverifiedReport] = []
    people = ctx.state.participants.values()
    newest = _find_newest_looks(ctx)
    for p in people:
        if not any(looks.last_ns < newest[name].first_ns for name, looks in p.looks.items()):
            continue
        for other in people:
            anchor_id = find_unverified_anchor(p, other)
            if anchor_id and len(reports) < MAX_REPORTED:
                reports.append(UnverifiedReport(p.id, other.id, anchor_id))
    return tuple(reports)


def _find_newest_looks(ctx: Context) -> dict[str, AnchorLooks]:
    """Return by anchor the looks of the headset that aligned by it last."""
    newest: dict[str, AnchorLooks] = {}
    for p in ctx.state.participants.values():
        for name, looks in p.looks.items():
            if name not in newest or looks.first_ns > newest[name].first_ns:
                newest[name] = looks
    return newest


def _verify_participant(ctx: Context, p: Participant) -> None:
    """Doubt the alignment of `p` if a pair with one who may drive is unverified, or end that doubt."""
    if not ctx.config.verify_pairs or p.connection == NO_CONNECTION:
        return
    partner, anchor_id = next(_list_partners(ctx, p), (None, ""))
    if partner is not None:
        text = f"glance at sheet '{anchor_id}': {partner.name} has aligned by it since you last saw it"
        run = "" if p.aligning else "; start your alignment run first"
        alignment.doubt_alignment(
            ctx, p, AlignmentDoubt.UNVERIFIED, f"{text}{run}; until then the next clutch moves nothing"
        )
    elif p.doubt == AlignmentDoubt.UNVERIFIED and p.correction is None:
        alignment.end_doubt(ctx, p)


def _list_partners(ctx: Context, p: Participant) -> Iterator[tuple[Participant, str]]:
    for other in ctx.state.participants.values():
        if other.role in Role.DRIVING:
            anchor_id = find_unverified_anchor(p, other)
            if anchor_id:
                yield other, anchor_id
