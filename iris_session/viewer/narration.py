"""Narration of a session by its events: sentences for the log, and lanes of states over time. Pure.

Participants go by name here, ids are in the data. A lane shows one thing that lasts: the holder of a robot, its clutch,
the reason why it holds, the alignment of a participant, who has an object, e-stop, pause, and the episode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

import msgspec

from iris_session.journal.messages import DenialRecord
from iris_session.journal.rows import CLOSED as CLASS_CLOSED
from iris_session.journal.rows import SessionHeader
from iris_session.protocol.common import Alignment
from iris_session.protocol.names import AlarmKind, AlignmentKind, AuditKind, EpisodeState, HoldReason
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AlignmentRun,
    AnchorMoved,
    Audited,
    ConsentRequested,
    EngagementChanged,
    EpisodeChanged,
    EStopChanged,
    Event,
    EventKind,
    Gap,
    Handover,
    HeadsetsCompared,
    Intervention,
    LeaseChanged,
    LeasesChanged,
    MarkerAdded,
    Notice,
    ObjectGrasped,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    SamplesRejected,
    ScaleChanged,
    SceneChanged,
    TipCalibrated,
)

Rgb = tuple[int, int, int]
#: Kinds of plots of participants: stated error of the alignment at the robot [mm], samples rejected since joining.
ALIGNMENT: Final = "alignment_mm"
REJECTED: Final = "rejected_samples"
#: Headsets disagree if they see a sheet apart by more than this multiple of the expected error.
MAX_ERROR_RATIO: Final = 2.0
DEBUG: Final = "DEBUG"
INFO: Final = "INFO"
WARN: Final = "WARN"
ERROR: Final = "ERROR"
CRITICAL: Final = "CRITICAL"

#: Colours of participants in the order of joining, after Okabe and Ito (2008): those of the page, in
#: `web_client/src/view/avatars.ts`.
PALETTE: Final[tuple[Rgb, ...]] = (
    (61, 155, 233),
    (230, 159, 0),
    (0, 179, 136),
    (214, 115, 171),
    (240, 228, 66),
    (86, 180, 233),
    (213, 94, 0),
)
_GREEN: Final = (95, 160, 95)
_BLUE: Final = (86, 140, 200)
_AMBER: Final = (200, 150, 50)
_RED: Final = (200, 60, 60)
_GREY: Final = (130, 135, 140)

#: Colour of a robot without a holder.
FREE: Final = _GREY

#: Maximum number of participants known by name, and of colours of one lane: sessions may last for weeks.
MAX_PEOPLE: Final = 1024
MAX_COLOURS: Final = 64

CLOSED: Final = "closed"
STOPPED: Final = "stopped"
PAUSED: Final = "paused"
#: Colours of states that mean the same in every session, by lane.
_CLUTCH: Final = {CLOSED: _GREEN}
_ESTOP: Final = {STOPPED: _RED}
_PAUSE: Final = {PAUSED: _AMBER}
_EPISODE: Final = {
    EpisodeState.SUCCESS: _GREEN,
    EpisodeState.FAILURE: _RED,
    EpisodeState.DISCARDED: _GREY,
    EpisodeState.UNKNOWN: _AMBER,
}
_NO_EPISODE: Final = (EpisodeState.IDLE, EpisodeState.CANCELLED)
#: What a line says of an episode in each state; of a final one, the state.
_EPISODE_WORDS: Final = {
    EpisodeState.COUNTDOWN: "counts down",
    EpisodeState.RUNNING: "runs",
    EpisodeState.CONFIRM: "discard?",
    EpisodeState.LEFT: "its leader is disconnected",
    EpisodeState.CLOSING: "closing",
}
_ALIGNMENT: Final = {AlignmentKind.MEASURED: _GREEN, AlignmentKind.PLACED: _BLUE, AlignmentKind.NOT_NEEDED: _GREY}

#: Ends of an engagement that its holder wanted.
_WANTED_HOLDS: Final = (HoldReason.CLUTCH_OPEN, HoldReason.REARM, HoldReason.NO_LEASE)
_NOTICES: Final = {"info": INFO, "warning": WARN, "error": ERROR}
_SCENES: Final = {
    "reset": "the scene is reset",
    "new_scene": "another scene is loaded",
    "patch": "the scene is changed",
    "external": "the user's loop has gone back in time",
}

#: A program or page that was in an earlier session tries the token of that one, and joins without: debugging.
_AUDITS: Final = {
    AuditKind.PAIRED: (INFO, "paired"),
    AuditKind.CODE_REFUSED: (WARN, "a wrong join code is refused"),
    AuditKind.CODE_EXHAUSTED: (WARN, "a join code is void after too many wrong ones"),
    AuditKind.KEY_REFUSED: (WARN, "a key that is not paired is refused"),
    AuditKind.KEY_REVOKED: (WARN, "a key is revoked"),
    AuditKind.ROLE_REFUSED: (WARN, "a role that the key may not have is refused"),
    AuditKind.REMOVED: (WARN, "a director removes a participant"),
    AuditKind.RENAMED: (INFO, "a name is changed"),
    AuditKind.ROLE_CHANGED: (INFO, "a director changes a role"),
    AuditKind.GATEWAY_REFUSED: (WARN, "a message in the name of another is refused"),
    AuditKind.TOKEN_REFUSED: (DEBUG, "joins anew, its resume token is not known here"),
    AuditKind.TOKEN_MISUSED: (WARN, "comes with the resume token of another key and is refused"),
    AuditKind.FLOOD: (WARN, "a client sends more than its limits"),
}


class LogLine(NamedTuple):
    """A line of the viewer's log. `level`: a Rerun log level."""

    level: str
    text: str


class LaneChange(NamedTuple):
    """A lane is in another state from now on. `lane`: parts of its path. `state`: empty when nothing is in force.

    `colours`: of its states, as far as they have colours of their own.
    """

    lane: tuple[str, ...]
    state: str
    colours: Mapping[str, Rgb]


class NarratedEvent(NamedTuple):
    """An event as people read it, and what it changes.

    `plots`: values by kind of plot and participant; `None`: there is none any more. `worst_at_anchor_m`: largest stated
    error at an anchor of the alignments in force after it [m].
    """

    line: LogLine
    lanes: list[LaneChange]
    plots: list[tuple[str, str, float | None]]
    worst_at_anchor_m: float


class Person(NamedTuple):
    """A participant as the picture shows it."""

    name: str
    role: str = ""
    worn: bool = True


class EventNarration:
    """State of a session as far as its events tell it. Give it every event, in order.

    `is_first`: the file is no later part of a recording, in whose lanes something may be in force from the start.
    `roles`: of everyone so far, by name. `handovers`, `episodes`: numbers so far.
    """

    def __init__(self, *, is_first: bool = True) -> None:
        self._before = "" if is_first else None
        self._people: dict[str, Person] = {}
        self._holders: dict[str, list[str]] = {}
        self._lanes: dict[tuple[str, ...], str] = {}  # those in which something is in force
        self._colours: dict[tuple[str, ...], dict[str, Rgb]] = {}  # of lanes of participants
        self._changes: list[LaneChange] = []
        self._plots: list[tuple[str, str, float | None]] = []
        self._versions: dict[str, int] = {}  # of alignments, by participant
        self._errors_m: dict[str, float] = {}  # stated errors at the anchor, by participant
        self._agreed: dict[tuple[str, str], bool] = {}  # whether the last check of two headsets was as expected
        self.roles: dict[str, str] = {}
        self.handovers = 0
        self._episodes: set[int] = set()
        self._rejected: dict[str, Counter[tuple[str, str]]] = {}  # since joining, by participant

    def add(self, event: Event) -> NarratedEvent:
        """Return what an event means."""
        self._changes, self._plots = [], []
        line = self._describe(event.body)
        return NarratedEvent(line, self._changes, self._plots, max(self._errors_m.values(), default=0.0))

    def add_hold(self, robot: str, reason: str) -> list[LaneChange]:
        """Return the change of the lane of a robot that holds for `reason` from now on, or moves (empty)."""
        self._changes = []
        self._set(("robots", robot, "hold"), "" if reason == HoldReason.NO_LEASE else _to_words(reason))
        return self._changes

    def add_people(self, people: Iterable[ParticipantInfo]) -> None:
        """Take over participants that joined before this file began."""
        for info in people:
            self._learn(info)

    @property
    def episodes(self) -> int:
        return len(self._episodes)

    def find_person(self, participant: str) -> Person:
        """Return a participant; of one that is not known, the id is the name."""
        return self._people.get(participant) or Person("the session" if participant in ("", "host") else participant)

    def _name(self, participant: str) -> str:
        return self.find_person(participant).name

    def _names(self, participants: Iterable[str]) -> str:
        return " and ".join(self._name(one) for one in participants)

    def _learn(self, info: ParticipantInfo) -> Person | None:
        """Remember a participant. Return what was known of it."""
        before = self._people.pop(info.id, None)
        while len(self._people) >= MAX_PEOPLE:
            del self._people[next(iter(self._people))]
        self._people[info.id] = Person(info.name, info.role, info.worn)
        if len(self.roles) < MAX_PEOPLE or info.name in self.roles:
            self.roles[info.name] = info.role
        return before

    def _set(self, lane: tuple[str, ...], state: str, colours: Mapping[str, Rgb] | None = None) -> None:
        if self._lanes.get(lane, self._before) == state:
            return
        if state:
            self._lanes[lane] = state
        else:
            self._lanes.pop(lane, None)
        self._changes.append(LaneChange(lane, state, colours or {}))

    def _set_people(self, lane: tuple[str, ...], people: list[str], state: str = "{}") -> None:
        """Set a lane to the names of `people`, in the colour of the first."""
        if not people:
            self._set(lane, "")
            return
        state = state.format(" + ".join(self._name(one) for one in people))
        colours = self._colours.setdefault(lane, {})
        if len(colours) < MAX_COLOURS:
            colours[state] = find_colour(people[0])
        self._set(lane, state, dict(colours))

    def _set_alignment(self, participant: str, alignment: Alignment | None) -> None:
        kind = AlignmentKind.NONE if alignment is None else alignment.kind
        state = "" if kind == AlignmentKind.NONE else kind
        self._errors_m.pop(participant, None)
        error_mm = None
        if alignment is not None and kind == AlignmentKind.MEASURED and not alignment.offset:
            self._errors_m[participant] = alignment.error_at_anchor_m
            error_mm = alignment.error_at_robot_m * 1e3
        self._plots.append((ALIGNMENT, participant, error_mm))
        self._set(("alignment", self._name(participant)), state, _ALIGNMENT)

    def _describe(self, body: EventKind) -> LogLine:
        match body:
            case ParticipantJoined(participant=info, resumed=resumed):
                self._learn(info)
                self._set_alignment(info.id, info.alignment)
                return LogLine(INFO, f"{info.name} is back" if resumed else f"{info.name} joins as {info.role}")
            case ParticipantChanged(participant=info):
                return self._describe_change(info)
            case ParticipantLeft(participant=who, reason=reason, grace=grace):
                if grace:
                    return LogLine(WARN, f"{self._name(who)} is disconnected ({reason})")
                self._set_alignment(who, None)
                self._rejected.pop(who, None)
                self._plots.append((REJECTED, who, None))
                self._agreed = {pair: agreed for pair, agreed in self._agreed.items() if who not in pair}
                return LogLine(INFO, f"{self._name(who)} leaves ({reason})")
            case LeaseChanged():
                return self._describe_lease(body)
            case LeasesChanged():
                lines = [self._describe_lease(change) for change in body.to_single_changes()]
                level = INFO if any(line.level == INFO for line in lines) else DEBUG
                return LogLine(level, "; ".join(line.text for line in lines if line.level == level))
            case ConsentRequested(target=target, requester=requester, holder=holder):
                return LogLine(INFO, f"{self._name(requester)} asks {self._name(holder)} for {target}")
            case Intervention(robot=robot, human=human, agent=agent, active=active):
                one, other = (human, agent) if active else (agent, human)
                return LogLine(INFO, f"{self._name(one)} takes over {robot} from {self._name(other)}")
            case EngagementChanged(robot=robot, participant=who, engaged=engaged, reason=reason):
                self._set(("robots", robot, "clutch"), CLOSED if engaged else "", _CLUTCH)
                if engaged:
                    return LogLine(DEBUG, f"{self._name(who)} closes the clutch of {robot}")
                level = DEBUG if reason in _WANTED_HOLDS else INFO
                return LogLine(level, f"{self._name(who)} no longer moves {robot} ({_to_words(reason)})")
            case ScaleChanged(robot=robot, scale=scale, participant=who):
                return LogLine(INFO, f"{self._name(who)} sets the motion scaling of {robot} to {scale:g}")
            case ObjectGrasped(object=thing, participant=who, device=device, grasped=grasped):
                self._set_people(("objects", thing), [who] if grasped else [])
                verb = "grasps" if grasped else "releases"
                return LogLine(INFO, f"{self._name(who)} {verb} {thing} with the {_to_device(device)}")
            case Handover():
                return self._describe_handover(body)
            case SceneChanged(cause=cause):
                if cause != "patch":
                    ends = ("clutch", "hold") if cause == "new_scene" else ("clutch",)
                    for lane in [one for one in self._lanes if one[0] == "objects" or one[-1] in ends]:
                        self._set(lane, "")
                return LogLine(INFO, _SCENES.get(cause, f"the scene changes ({cause})"))
            case EStopChanged(active=active, participant=who, reason=reason):
                self._set(("e-stop",), STOPPED if active else "", _ESTOP)
                if not active:
                    return LogLine(WARN, f"{self._name(who)} clears the e-stop")
                by = self._name(who) if who else "a connection that has not joined"
                return LogLine(CRITICAL, f"E-STOP by {by}" + (f": {reason}" if reason else ""))
            case PauseChanged(paused=paused, participant=who, reason=reason):
                self._set(("pause",), PAUSED if paused else "", _PAUSE)
                text = f"{self._name(who)} {'pauses' if paused else 'resumes'} the simulation"
                return LogLine(INFO, text + (f": {reason}" if reason else ""))
            case EpisodeChanged(number=number, state=state, label=label, participant=who):
                if state in EpisodeState.RECORDED:
                    self._episodes.add(number)
                shown = f"episode {number}" if state in EpisodeState.RECORDED else state
                self._set(("episode",), "" if state in _NO_EPISODE else shown, _EPISODE)
                text = f"episode {number}: {_EPISODE_WORDS.get(state, state)}"
                return LogLine(INFO, f"{text}{f', {label}' if label else ''} ({self._name(who)})")
            case _:
                return self._describe_other(body)

    def _describe_other(self, body: EventKind) -> LogLine:
        """Return the line of an event that changes no lane, except of an alignment."""
        match body:
            case AlignmentChanged(participant=who, alignment=alignment):
                self._set_alignment(who, alignment)
                aged = self._versions.get(who) == alignment.version
                self._versions[who] = alignment.version
                if aged:
                    text = f"the alignment of {self._name(who)} is good to {alignment.error_at_robot_m * 1e3:.1f} mm"
                    return LogLine(DEBUG, text)
                if alignment.kind == AlignmentKind.NONE:
                    return LogLine(WARN, f"{self._name(who)} is not aligned any more")
                stated = alignment.kind == AlignmentKind.MEASURED and alignment.error_at_robot_m > 0.0
                error = f" to {alignment.error_at_robot_m * 1e3:.1f} mm" if stated and not alignment.offset else ""
                return LogLine(INFO, f"{self._name(who)} is aligned{error} ({_to_words(alignment.kind)})")
            case AlignmentRun(participant=who, running=running):
                return LogLine(INFO, f"the alignment of {self._name(who)} {'begins' if running else 'ends'}")
            case AlignmentAlarmed(witnesses=witnesses, anchor_id=anchor, size_m=size_m) if witnesses:
                return LogLine(WARN, f"{anchor} was moved by {size_m * 1e3:.1f} mm, several headsets see it")
            case AlignmentAlarmed(participant=who, kind=AlarmKind.TWO_PLACES, anchor_id=anchor, size_m=size_m):
                text = f"{self._name(who)} sees {anchor} in two places, {size_m:.2f} m apart"
                return LogLine(WARN, text)
            case AlignmentAlarmed(participant=who, kind=kind, anchor_id=anchor, size_m=size_m):
                text = f"the alignment of {self._name(who)} is wrong by {size_m * 1e3:.1f} mm at {anchor} ({kind})"
                return LogLine(WARN, text)
            case AnchorMoved(anchor_id=anchor, T_world_anchor=pose, by=by):
                x, y, z = pose.p
                return LogLine(INFO, f"{self._name(by)} moves anchor {anchor} to ({x:.3f}, {y:.3f}, {z:.3f}) m")
            case TipCalibrated(participant=who, device=device, error_m=error_m, refused=refused, advice=advice):
                tip = f"the tip of {self._name(who)}'s {_to_device(device)}"
                if refused:
                    return LogLine(WARN, f"{tip} is not calibrated: {advice}")
                return LogLine(INFO, f"{tip} is calibrated to {error_m * 1e3:.1f} mm")
            case HeadsetsCompared(a, b, anchor, error_m, expected_p95_m=expected_m, touched=touched):
                pair, agree = (min(a, b), max(a, b)), error_m <= MAX_ERROR_RATIO * expected_m
                is_news = touched or self._agreed.get(pair) is not agree  # every five seconds for every pair
                self._agreed[pair] = agree
                verb = "touch" if touched else "see"
                text = f"{self._name(a)} and {self._name(b)} {verb} {anchor} {error_m * 1e3:.1f} mm apart"
                return LogLine(
                    INFO if is_news else DEBUG, f"{text}, 95 % of such pairs are below {expected_m * 1e3:.1f} mm"
                )
            case SamplesRejected(participant=who, device=device, reason=reason, count=count):
                rejected = self._rejected.setdefault(who, Counter())
                rejected[device, reason] = count
                self._plots.append((REJECTED, who, rejected.total()))
                text = f"{self._name(who)}'s {_to_device(device)}: {count} samples rejected ({_to_words(reason)})"
                return LogLine(DEBUG, text)
            case Audited(kind=kind, name=name, address=address, detail=detail, count=count):
                level, text = _AUDITS.get(kind, (WARN, _to_words(kind)))
                parts = (name, address, detail, f"{count} times" if count > 1 else "")
                return LogLine(level, f"{text}: {', '.join(filter(None, parts))}")
            case MarkerAdded(participant=who, text=text):
                return LogLine(INFO, f"{self._name(who)}: {text}")
            case Notice(level=level, text=text, participant=who):
                named = not who or self._name(who) in text
                return LogLine(_NOTICES.get(level, WARN), text if named else f"{self._name(who)}: {text}")
            case Gap(kind=kind, duration_ns=duration_ns, rows=rows):
                if kind == "recording":
                    return LogLine(ERROR, f"{rows} rows of the recording are lost")
                if kind == "resumed":
                    return LogLine(INFO, f"the session is resumed, {duration_ns * 1e-9:.1f} s later")
                return LogLine(ERROR, f"no step for {duration_ns * 1e-9:.2f} s ({kind})")
            case _:
                fields = msgspec.to_builtins(body)
                kind = _to_words(fields.pop("event"))
                text = " ".join(f"{name}={value}" for name, value in fields.items() if value not in ("", None, [], ()))
                return LogLine(INFO, f"{kind}: {text}")

    def _describe_change(self, info: ParticipantInfo) -> LogLine:
        before = self._people.get(info.id, Person(info.name, info.role, info.worn))
        if before.name != info.name:
            self._set_alignment(info.id, None)
        self._learn(info)
        self._set_alignment(info.id, info.alignment)
        if before.name != info.name:
            return LogLine(INFO, f"{before.name} is called {info.name} from now on")
        if before.role != info.role:
            return LogLine(INFO, f"{info.name} is {info.role} from now on")
        if before.worn != info.worn:
            return LogLine(INFO, f"{info.name} {'puts the headset on' if info.worn else 'takes the headset off'}")
        return LogLine(DEBUG, f"{info.name}: tracking epoch {info.tracking_epoch}")

    def _describe_lease(self, change: LeaseChanged) -> LogLine:
        lease, cause = change.lease, _to_words(change.cause)
        before = self._holders.get(lease.target, [change.previous_holder] if change.previous_holder else [])
        after = [who for who in dict.fromkeys((lease.holder, *lease.sub_holders)) if who]
        self._holders[lease.target] = after
        folder = "robots" if lease.kind == "robot" else "objects"
        if folder == "robots":
            self._set_people((folder, lease.target, "holder"), after)
        gained, lost = [who for who in after if who not in before], [who for who in before if who not in after]
        reason = "" if cause in ("acquired", "released", "left") else f" ({cause})"
        if gained and lost:
            return LogLine(INFO, f"{self._names(gained)} takes {lease.target} from {self._names(lost)}{reason}")
        if gained:
            return LogLine(INFO, f"{self._names(gained)} takes {lease.target}{reason}")
        if lost:
            return LogLine(INFO, f"{self._names(lost)} gives {lease.target} back{reason}")
        waits = f"{self._names(lease.queue)} waits for {lease.target}" if lease.queue else lease.target
        return LogLine(DEBUG, f"{waits} ({cause})")

    def _describe_handover(self, body: Handover) -> LogLine:
        self.handovers += 1
        giver, receiver = body.giver_participant, body.receiver_participant
        if giver and receiver and giver != receiver:
            passed = f"{self._name(giver)} to {self._name(receiver)}"
        else:
            passed = f"{body.giver} to {body.receiver}"
        # No event says when a robot lets it go, so the lane states no more than the event.
        if receiver:
            self._set_people(("objects", body.object), [receiver], "handed to {}")
        else:
            self._set(("objects", body.object), f"handed to {body.receiver}")
        return LogLine(INFO, f"{body.object} handed over: {passed}, both held it for {body.duration_ns * 1e-9:.2f} s")


def _to_words(value: str) -> str:
    return value.replace("_", " ")


def _to_device(device: str) -> str:
    """Return `left controller` for `controller/left`."""
    kind, _, side = device.partition("/")
    return f"{side} {kind}" if side else kind


def find_colour(participant: str) -> Rgb:
    """Return the colour of a participant: ids are `p1`, `p2`, ... in the order of joining."""
    number = participant[1:]
    return PALETTE[(int(number) - 1 if number.isdecimal() else len(participant)) % len(PALETTE)]


# --- other texts for the viewer --------------------------------------------------------------------------------------


def describe_denial(record: DenialRecord) -> LogLine:
    """Return the log line of a denial: connection, reason, message, holder and advice."""
    denial = record.denial
    parts = [f"connection {record.connection}: {denial.reason}: {denial.message}"]
    if denial.holder:
        parts.append(f"held by {denial.holder_name or denial.holder}")
    if denial.advice:
        parts.append(denial.advice)
    return LogLine(WARN, "; ".join(parts))


def describe_session(header: SessionHeader, narration: EventNarration | None = None, duration_s: float = 0.0) -> str:
    """Return a Markdown page about the recording. `narration`: at its end; `None`: it begins."""
    versions = "\n".join(f"| {name} | {value} |" for name, value in header.versions.items())
    parts = [f"# {header.session_name}"]
    if narration is not None:
        people = ", ".join(f"**{name}** ({role})" for name, role in narration.roles.items()) or "No one joined"
        counts = f"{duration_s:.1f} s, handovers: {narration.handovers}, episodes: {narration.episodes}"
        parts.append(f"{people}. {counts}.")
    parts += [
        f"Robots: {', '.join(r.name for r in header.robots) or 'none'}. "
        f"Objects: {', '.join(o.name for o in header.objects) or 'none'}. "
        f"Bodies: {len(header.bodies)}. Tick: {header.tick_period_ns / 1e6:g} ms.",
        f"Recorded {header.created_utc}, class **{header.recording_class}**: `iris-session verify FILE` simulates "
        + ("it again." if header.recording_class == CLASS_CLOSED else "decisions and control again."),
        f"Session `{header.session_id}`",
        f"| library | version |\n|---|---|\n{versions}\n",
    ]
    return "\n\n".join(parts)
