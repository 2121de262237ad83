"""Events in the viewer: lines of the log, lanes of states over time, plots of participants, and what they change in 3D.

`EventNarration` says what an event means; here it is logged. Exact events are columns that the writer of the file adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import rerun as rr

from iris_session.journal.messages import HoldRecord, MetricRecord
from iris_session.protocol.common import Applied
from iris_session.protocol.server_messages import (
    AnchorMoved,
    Event,
    ParticipantLeft,
    SceneChanged,
)
from iris_session.rrd import paths
from iris_session.viewer.narration import (
    FREE,
    EventNarration,
    LaneChange,
    LogLine,
    NarratedEvent,
    Rgb,
)
from iris_session.viewer.participant_layer import AnchorLayer, ParticipantLayer
from iris_session.viewer.plots import INPUT_TO_STEP, STATE_AGE, MetricPlots
from iris_session.viewer.scene_layer import escape_entity_part
from iris_session.viewer.timelines import Moment, MomentTable

#: Maximum number of lanes whose colours are known to be in the file: participants that come and go have one each.
MAX_LANES: Final = 4096


class EventLayer:
    """Log, lanes and metrics of one file. `participants`, `anchors`: the layers that events change."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        moments: MomentTable,
        narration: EventNarration,
        participants: ParticipantLayer,
        anchors: AnchorLayer,
    ) -> None:
        self._rec = recording
        self._moments = moments
        self._narration = narration
        self._participants = participants
        self._anchors = anchors
        self._metrics = MetricPlots(recording, narration)
        self._applied: dict[str, Applied] = {}
        self._lanes: dict[str, list[tuple[Moment, LaneChange]]] = {}
        self._lane_colours: dict[str, dict[str, Rgb]] = {}

    def draw_events(self, events: Sequence[Event], narrated: Sequence[NarratedEvent]) -> list[Any]:
        """Show what events change. Return the columns of their log lines."""
        changes = []
        for event, one in zip(events, narrated, strict=True):
            changes += [(event.step, event.session_time, change) for change in one.lanes]
            moment = self._moments.find(event.step, event.session_time)
            for kind, participant, value in one.plots:
                if value is None:
                    self._metrics.end(kind, participant, moment)
                else:
                    self._metrics.add(kind, participant, value, moment)
            if one.plots:
                self._anchors.set_error(one.worst_at_anchor_m, self._find_anchor_moment(moment))
            if isinstance(event.body, ParticipantLeft) and not event.body.grace:
                self._participants.remove(event.body.participant, moment)
            elif isinstance(event.body, AnchorMoved):
                pose = event.body.T_world_anchor
                self._anchors.move(event.body.anchor_id, pose, self._find_anchor_moment(moment))
            elif isinstance(event.body, SceneChanged) and event.body.cause == "new_scene":
                self._participants.label_robots({}, moment)
        self._add_lanes(changes)
        return make_log_columns([one.line for one in narrated])

    def add_holds(self, holds: Sequence[HoldRecord]) -> None:
        """Collect why robots hold."""
        self._add_lanes(
            [(h.step, h.session_time, c) for h in holds for c in self._narration.add_hold(h.robot, h.reason)]
        )

    def add_metrics(self, metrics: Sequence[MetricRecord]) -> None:
        """Collect values for the plots."""
        for record in metrics:
            kind, _, subject = record.name.partition("/")
            self._metrics.add(kind, subject, record.value, self._moments.find(record.step, record.session_time))

    def add_latencies(self, applied: Sequence[Applied], step: int, session_ns: int) -> None:
        """Collect latencies for the plots: from the capture of a sample to its step, per robot."""
        for one in applied:
            if self._applied.get(one.robot) != one:
                self._applied[one.robot] = one
                latency_ms = (one.step_ns - one.capture_ns) / 1e6
                self._metrics.add(INPUT_TO_STEP, one.robot, latency_ms, self._moments.find(step, session_ns))

    def add_state_ages(self, reports: Sequence[tuple[str, int, float]]) -> None:
        """Collect how old states are that reach participants: id, session time [ns], age [ms]."""
        for participant, receive_ns, age_ms in reports:
            moment = self._moments.find(self._moments.newest.step, receive_ns)
            self._metrics.add(STATE_AGE, participant, age_ms, moment)

    def write_metrics(self) -> None:
        """Write the values collected so far."""
        self._metrics.write(self._moments.newest)

    def write_lanes(self) -> None:
        """Write changed lanes, and the colours of their states when those are new."""
        lanes, self._lanes = self._lanes, {}
        for entity, rows in lanes.items():
            colours = {state: colour for _, change in rows for state, colour in change.colours.items()}
            if colours and self._lane_colours.get(entity) != colours:
                if len(self._lane_colours) >= MAX_LANES:
                    self._lane_colours.clear()
                self._lane_colours[entity] = colours
                states = rr.StateConfiguration(values=[*colours], colors=[*colours.values()])
                self._rec.log(entity, states, static=True, strict=True)
            times = self._moments.spread(entity, [moment for moment, _ in rows])
            columns = rr.StateChange.columns(state=[change.state for _, change in rows])
            rr.send_columns(entity, times, [*columns], recording=self._rec, strict=True)

    def _find_anchor_moment(self, moment: Moment) -> Moment:
        """Return the moment of an event that may change anchors; no two are equal."""
        return self._moments.make(
            moment.step, moment.sim_ns, self._moments.spread_one(paths.ANCHORS, moment.session_ns)
        )

    def _add_lanes(self, changes: Sequence[tuple[int, int, LaneChange]]) -> None:
        """Collect changed lanes; label robots by their holders."""
        for step, now_ns, change in changes:
            moment = self._moments.find(step, now_ns)
            entity = "/".join((paths.LANES, *map(escape_entity_part, change.lane)))
            self._lanes.setdefault(entity, []).append((moment, change))
            folder, name, *kind = (*change.lane, "")
            if folder == "robots" and kind[0] == "holder":
                self._participants.label_robot(name, change.state, change.colours.get(change.state, FREE), moment)


def make_log_columns(lines: Sequence[LogLine]) -> list[Any]:
    """Return the columns of lines of the log."""
    columns = rr.TextLog.columns(text=[line.text for line in lines], level=[line.level for line in lines])
    return [*columns]
