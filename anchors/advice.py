"""What the wearer of a headset is told to do about an alignment that cannot be had, or not well enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from anchors.groups import ViewpointGroup, GroupKey
from anchors.pose import Vec3, distance

LOOK: Final = "look at the anchor sheet for a few seconds, from about half a metre"
CONTRADICT: Final = (
    "observations contradict each other: did the sheet move, or the headset lose tracking? hold still, look at the "
    "sheet again"
)


def disagreement_advice(anchor_ids: Sequence[str]) -> str:
    """Why nothing can be said, with the names when several sheets take part in it."""
    if len(anchor_ids) < 2:
        return CONTRADICT
    return f"{CONTRADICT}; one of these was moved: {', '.join(anchor_ids)}"


def gravity_advice(against_gravity: int, taken: int) -> str:
    """Where nearly everything that was seen contradicts gravity."""
    if against_gravity <= 2 * taken or against_gravity < 5:
        return ""
    return "the sheet is not mounted as configured (lying, or on a wall): its pose contradicts the vertical"


def tilt_advice(tilt_rad: float) -> str:
    """What was seen agrees with itself, but not with gravity."""
    return (
        f"the sheet is tilted by {math.degrees(tilt_rad):.0f} deg against the headset's vertical: lay it level, or "
        "configure how it lies"
    )


def size_advice(groups: Mapping[GroupKey, ViewpointGroup], tolerance: float) -> str:
    """Warns about a sheet that is seen in several sizes; single measurements that are off do not count."""
    extremes: dict[str, tuple[float, float]] = {}
    for (anchor_id, _), group in groups.items():
        if group.sizes is not None:
            low, high = extremes.get(anchor_id, group.sizes)
            extremes[anchor_id] = (min(low, group.sizes[0]), max(high, group.sizes[1]))
    for anchor_id, (least, most) in extremes.items():
        if most - least <= tolerance * least:
            continue  # then no quantiles are further apart
        seen = sorted(size for (name, _), group in groups.items() if name == anchor_id for size in group.list_sizes())
        low, high = seen[len(seen) // 10], seen[(9 * len(seen)) // 10 if len(seen) > 1 else 0]
        if high - low > tolerance * low:
            return f"sheet '{anchor_id}' is seen in different sizes: is there a second one, printed at another scale?"
    return ""


def error_advice(error_m: float, limit_m: float, pivot_world: Vec3, point_world: Vec3, n_viewpoints: int) -> str:
    """How to bring the error at a point below its limit; empty when it is."""
    if error_m <= limit_m:
        return ""
    far = distance(pivot_world, point_world)
    wrong = f"the error {far:.1f} m from the sheet would be {error_m * 1e3:.0f} mm, {limit_m * 1e3:.0f} are allowed: "
    if n_viewpoints < 3:
        return wrong + "look at the sheet from several sides, from about half a metre"
    if far > 0.8:
        return wrong + "add a sheet near the robot"
    return wrong + "step closer to the sheet"
