"""Weigh what one headset has seen, where looks contradict each other: a sheet or the tracking frame was moved, or a
scale is wrong.

A sheet that is seen elsewhere than before was moved, or the tracking frame was. One sheet alone cannot tell; the next
one that is looked at does.

A print of another size than configured, and a focal length that is wrong, show as distances that are too large or too
small by the same share. An error that sheets have in common is that of the camera; a sheet that differs from the others
was printed at another scale. With one sheet, an error beyond what printers do is that of the camera, most probably. A
scale is an unknown only where the looks show it: careful prints are exact to a few tenths of a percent, and an unknown
that is not needed costs accuracy.

Pure: the mathematics of a solution is in `anchors.solver`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from anchors.solver import (
    N_FRAME,
    AlignmentPrior,
    AlignmentProblem,
    AlignmentSolution,
    Mask,
    list_agreeing_anchors,
    score_scale,
    select_groups,
    solve_alignment,
    solve_with_scale,
)
from anchors.uncertainty import Z999, chi2_quantile
from anchors.viewpoints import MergedObservation

#: What changed between earlier and later looks: nothing, the sheet, the tracking frame, or that is not known yet.
Verdict = Literal["nothing", "sheet", "frame", "open"]
#: In standard deviations: from here on a scale is an unknown, and from here on it is said in words.
_SUSPECT: Final = 3.0
_CERTAIN: Final = 4.0
#: Smaller errors are not worth words [share].
_WORTH_WORDS: Final = 0.01
#: No printer is off by more: beyond it is the camera, if only one sheet was seen [share].
_MAX_PRINT: Final = 0.03
_MIN_LOOKS: Final = 2
_MAX_SHEETS: Final = 8


class Opinion(NamedTuple):
    """Result of weighing earlier looks: whether those at one sheet fitted, and which other sheets agreed with each
    other."""

    fitted: bool
    others: tuple[str, ...]


def weigh_earlier_looks(b: AlignmentProblem, sheet: str, prior: AlignmentPrior) -> Opinion:
    """Return what the looks before a contradiction say about the sheet that was then seen elsewhere."""
    agreeing = list_agreeing_anchors(b.anchor, solve_alignment(b, prior).inside)
    if len(set(b.anchor)) == 1:  # a single sheet is right about itself, even if two looks contradict each other
        agreeing = set(b.anchor)
    return Opinion(sheet in agreeing, tuple(sorted(agreeing - {sheet})))


def weigh_change(b: AlignmentProblem, later: Mask, sheet: str, prior: AlignmentPrior) -> Verdict:
    """Decide what changed, given all looks.

    Two sheets that agree with each other in later looks, and not with the earlier ones, mean the frame. A sheet that
    was moved contradicts its own earlier looks, while a later look at another one agrees with the earlier ones. A sheet
    that never agreed is outvoted by two others, and two sheets of one look each leave it open.

    Args:
        b: All looks.
        later: (G,) those since the contradiction.
        sheet: The sheet that showed it.
        prior: Prior of the alignment.
    """
    if not later.any():
        return "open"
    if later.all():
        return "nothing"
    names = np.array(b.anchor)
    everyone = solve_alignment(b, prior)
    earlier_inside = solve_alignment(select_groups(b, ~later), prior).inside
    later_inside = solve_alignment(select_groups(b, later), prior).inside
    now = list_agreeing_anchors(names[later].tolist(), later_inside)
    if len(now) >= 2:
        trusted = np.zeros(b.size, dtype=bool)  # looks that fitted their own time, of the sheets that agree now
        trusted[~later], trusted[later] = earlier_inside, later_inside
        trusted &= np.isin(names, sorted(now))
        return "nothing" if bool(np.all(everyone.inside[trusted])) else "frame"
    agreeing = list_agreeing_anchors(b.anchor, everyone.inside)
    is_majority = 2 * len(agreeing) > len(set(b.anchor))
    if bool(np.any(everyone.inside & later & (names == sheet))):
        return "nothing" if is_majority else "open"
    fitted = sheet in list_agreeing_anchors(names[~later].tolist(), earlier_inside)
    confirmed = bool(np.any(everyone.inside & later & (names != sheet)))
    if fitted:
        return "sheet" if confirmed else "open"
    return "nothing" if is_majority and len(agreeing - {sheet}) >= 2 else "open"


# --- errors of scale --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScaleError:
    """Observed distances are too large by `share` (+- `sigma`, standard deviation). `anchor_id`: of this sheet only;
    empty: of everything that the headset sees."""

    anchor_id: str
    share: float
    sigma: float
    single: bool

    @property
    def is_certain(self) -> bool:
        return abs(self.share) > max(_CERTAIN * self.sigma, _WORTH_WORDS)


def explain_by_scale(
    b: AlignmentProblem, s: AlignmentSolution, merged: Sequence[MergedObservation], prior: AlignmentPrior
) -> tuple[AlignmentProblem, AlignmentSolution, tuple[ScaleError, ...]] | None:
    """Return the solution with errors of scale as unknowns, if the looks are explained better by them.

    Args:
        b: All looks.
        s: Solution without.
        merged: The looks of the problem.
        prior: Prior of the alignment.
    """
    columns = np.zeros((b.size, 6, 1))
    for g, m in enumerate(merged):
        if m.p_head is not None:
            columns[g, :3, 0] = m.p - m.p_head
    looked = columns[:, 2, 0] != 0.0
    names = [one for one in dict.fromkeys(b.anchor) if sum(n == one for n in _select(b.anchor, looked)) >= 2]
    if int(looked.sum()) < _MIN_LOOKS or not names or len(names) > _MAX_SHEETS:
        return None
    each = columns * np.array([[name == one for one in names] for name in b.anchor])[:, None, :]
    if s.inside.all() and not np.any(np.abs(score_scale(b, s, each)) > _SUSPECT):
        return None
    start = (s.q, s.t)
    scaled, found = solve_with_scale(b, prior, start, each)
    if not _is_better(s, found):
        return None
    sigma = np.sqrt(np.diagonal(found.inverse)[N_FRAME:])
    information = 1.0 / sigma**2
    common = float(information @ found.scale / information.sum())
    spread = float(information @ (found.scale - common) ** 2)
    single = len(names) == 1
    if single:
        return scaled, found, (ScaleError(names[0], float(found.scale[0]), float(sigma[0]), True),)
    if spread <= chi2_quantile(len(names) - 1.0, Z999) and abs(common) > _SUSPECT / float(np.sqrt(information.sum())):
        scaled, found = solve_with_scale(b, prior, start, columns)
        error = ScaleError("", float(found.scale[0]), float(np.sqrt(found.inverse[N_FRAME, N_FRAME])), False)
        return (scaled, found, (error,)) if _is_better(s, found) else None
    wrong = np.abs(found.scale) > _SUSPECT * sigma
    if not wrong.any():
        return None
    scaled, found = solve_with_scale(b, prior, start, each[:, :, wrong])
    sigma = np.sqrt(np.diagonal(found.inverse)[N_FRAME:])
    errors = zip(_select(names, wrong), found.scale.tolist(), sigma.tolist(), strict=True)
    return (scaled, found, tuple(ScaleError(*one, False) for one in errors)) if _is_better(s, found) else None


def _select(names: Sequence[str], which: Mask) -> list[str]:
    return [name for name, ok in zip(names, which.tolist(), strict=True) if ok]


def _is_better(without: AlignmentSolution, found: AlignmentSolution) -> bool:
    """Return whether no look is lost, and what is left is noise."""
    if not found.inside.all() and int(found.inside.sum()) <= int(without.inside.sum()):
        return False
    if int(found.inside.sum()) < _MIN_LOOKS or 5 * int(found.inside.sum()) < 4 * len(found.inside):
        return False
    return found.freedom > 0.0 and found.chi2 <= chi2_quantile(found.freedom, Z999)


def describe_scale(errors: Sequence[ScaleError], sizes: Mapping[str, float]) -> str:
    """Return what certain errors of scale mean in words, empty if none is certain. `sizes`: configured edges [m]."""
    parts = []
    for e in errors:
        if not e.is_certain:
            continue
        camera = f"this headset's camera model is off by {abs(e.share) * 100.0:.1f} %"
        size = sizes.get(e.anchor_id, 0.0)
        measured = f"{size / (1.0 + e.share) * 1e3:.0f} mm, not {size * 1e3:.0f} mm"
        larger = f"{abs(e.share) * 100.0:.1f} % {'less' if e.share > 0.0 else 'more'} than configured"
        sheet = f"sheet '{e.anchor_id}' measures {measured if size > 0.0 else larger}"
        if not e.anchor_id:
            parts.append(camera)
        elif not e.single:
            parts.append(sheet)
        elif abs(e.share) > _MAX_PRINT:
            parts.append(f"{camera}, or {sheet}: measure it with a ruler")
        else:
            parts.append(f"{sheet}: printed at the wrong scale? measure it with a ruler (or {camera})")
    return "; ".join(parts)
