"""Events about alignments beyond `AlignmentChanged`: runs, alarms, moved anchors, and what pairs of headsets show."""

from __future__ import annotations

from iris_session.protocol.common import Count, EventBody, Name, Names, Pose, Vec3


class AlignmentRun(EventBody, frozen=True, tag="alignment_run"):
    """The alignment run of a participant was started anew (`running`), or stopped. `run` counts the starts."""

    participant: Name
    running: bool
    run: Count
    by: Name = ""


class AlignmentAlarmed(EventBody, frozen=True, tag="alignment_alarmed"):
    """The alignment of a participant was found wrong by `size_m` (`AlarmKind`); a `jump` has voided it. `beside`:
    anchors that stayed where they were meanwhile: then the anchor was moved, not the headset."""

    participant: Name
    kind: Name
    anchor_id: Name
    size_m: float
    beside: Names = ()


class AnchorMoved(EventBody, frozen=True, tag="anchor_moved"):
    """A director moved an anchor: alignments to it follow."""

    anchor_id: Name
    T_world_anchor: Pose
    by: Name = ""


class HeadsetsCompared(EventBody, frozen=True, tag="headsets_compared"):
    """Measured: participants `a` and `b` put one thing (`anchor_id`), at `p_world`, `error_m` and `error_rad` apart.

    `expected_p95_m`: what 95 % of such pairs stay below by their stated errors and the noise of these `n` looks.
    """

    a: Name
    b: Name
    anchor_id: Name
    error_m: float
    error_rad: float
    expected_p95_m: float
    p_world: Vec3
    n: Count
