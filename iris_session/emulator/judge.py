"""Compares what a headset believes with the truth, which only the emulator knows."""

from __future__ import annotations

import math

from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_angle
from iris_session.emulator.specs import HeadsetReport
from iris_session.protocol.common import Alignment


def judge(
    report: HeadsetReport, alignment: Alignment | None, T_world_tracking_true: PoseTuple, p_world_sheet: Vec3
) -> None:
    """Fills in the errors of `alignment`. Without one, those of the last stay; `T_true_shown` tells."""
    if alignment is None:
        report.T_true_shown = None
        return
    believed: PoseTuple = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
    shown = compose(T_world_tracking_true, inverse(believed))
    x, y, z = p_world_sheet
    around: list[Vec3] = [(x + 1, y, z), (x - 1, y, z), (x, y + 1, z), (x, y - 1, z), (x, y, z + 1)]
    report.T_true_shown = shown
    report.alignment_version = alignment.version
    report.alignment_error_mm = 1e3 * distance(apply(shown, p_world_sheet), p_world_sheet)
    report.alignment_error_1m_mm = 1e3 * max(distance(apply(shown, p), p) for p in around)
    report.alignment_error_deg = math.degrees(quat_angle(believed[1], T_world_tracking_true[1]))
    report.stated_error_mm = 1e3 * alignment.error_at_anchor_m
