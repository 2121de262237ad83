"""Checks of a `StatusReport`: media streams, by their sources and by what participants get of them. Pure."""

from __future__ import annotations

from typing import Final

from iris_session.doctor.findings import Finding, report_problems
from iris_session.protocol.names import BudgetClass, StreamFault
from iris_session.protocol.status import MediaStreamReport, ParticipantReport

#: Fewer drops are normal while the budget of a link is being found: one second of a camera.
MEDIA_DROPS: Final = 30
#: Cause of each fault of a stream, and advice.
FAULTS: Final = {
    StreamFault.FROZEN: ("the camera delivers the same picture over and over", "unplug it, plug it in, restart it"),
    StreamFault.NO_DEPTH: (
        "no pixel has a depth: the camera is covered, or all it sees is nearer or farther than it measures",
        "uncover the camera, and check from where it measures",
    ),
    StreamFault.SATURATED: (
        "the depth is at the end of its range: strong light, or a surface right before the camera",
        "shade the scene from the sun, or move the camera back and calibrate it again",
    ),
    StreamFault.SIZE: (
        "its pictures have another size than its intrinsics, or depth another than colour",
        "set the size of the calibration, with depth registered to colour, or calibrate it in this size",
    ),
    StreamFault.POSE: (
        "the pose of the camera has values that are no numbers, or that of the body which carries it or of the robots "
        "to be removed is not known when it sees something",
        "check its pose and the name of its body against the scene, and the network to the camera",
    ),
    StreamFault.CLOCK: (
        "its times of capture jump, lie in the future, or are not those of the other cameras",
        "check the clock of the machine with the camera, and its driver",
    ),
    StreamFault.SLOW: (
        "its device, disk or machine does not keep the rate",
        "a port or disk of its own, fewer pixels, or a lower rate",
    ),
    StreamFault.SOURCE: (
        "its device or recording delivers no frames",
        "check cable and power, and that no other program has the device",
    ),
}
_SILENT: Final = (
    "its source has ended, hangs, cannot reach the session, or does not repeat the frame of a stream at rest",
    "check the program that publishes it, and the network to it",
)


def check_streams(streams: tuple[MediaStreamReport, ...]) -> Finding:
    """Report streams whose source found a fault, or whose newest frame is missing or too old for their rate."""
    bad = [one for one in streams if one.fault or one.stale]
    found = [FAULTS.get(one.fault, ("", "")) if one.fault else _SILENT for one in bad]
    named = dict.fromkeys(f"{one.stream}: {why}" for one, (why, _) in zip(bad, found, strict=True) if why)
    advice = dict.fromkeys(what for _, what in found if what)
    fine = ", ".join(one.stream for one in streams) or "none"
    return report_problems(
        "streams", [_describe_problem(one) for one in bad], fine, "; ".join(named), "; ".join(advice)
    )


def _describe_problem(one: MediaStreamReport) -> str:
    title = f"{one.stream} ({one.title})" if one.title else one.stream
    source = f" from {one.source}" if one.source else ""
    fault = f"{one.fault}{f' ({one.detail})' if one.detail else ''}" if one.fault else ""
    stale = f"no frame for {one.age_ms * 1e-3:.1f} s" if one.stale else ""
    return f"{title}{source}: {', '.join(filter(None, (fault, stale)))}"


def check_media(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report participants that receive less of clouds, cameras and deformables than is published."""
    texts = []
    for p in people:
        cut = [f"{one.stream} in class {one.budget_class}" for one in p.media if one.budget_class != BudgetClass.FULL]
        lost = f"{p.media_drops} frames dropped" if p.media_drops >= MEDIA_DROPS else ""
        if p.connected and (cut or lost):
            texts.append(f"{p.name}: {', '.join([*cut, *([lost] if lost else [])])}")
    wanted = any(p.media for p in people)
    fine = "every subscriber gets full streams" if wanted else "no participant subscribes to media"
    why = "their link has no more capacity; state and control have priority"
    advice = "a better network for them, or fewer and smaller streams; docs/evidence/links.md"
    return report_problems("media", texts, fine, why, advice)
