"""Events and samples of a recording in plain form: records with names beside ids, decoded samples with participants.

Nothing here simulates. Events are as in the session's history. Samples are the raw ones, before the session counted or
rejected them: poses in the sender's own tracking frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.errors import RecordingError
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.codec import BAD_BYTES
from iris_session.protocol.server_messages import Event, ParticipantChanged, ParticipantJoined
from iris_session.recording.observations import read_owners
from iris_session.recording.reader import Recording

#: Fields of events with the id of a participant; `by` of events, `holder` of leases.
ID_FIELDS: Final = frozenset(
    (
        *("participant", "by", "holder", "previous_holder", "requester", "human", "agent"),
        *("giver_participant", "receiver_participant", "a", "b"),
    )
)
#: Fields with several.
ID_LIST_FIELDS: Final = frozenset(("previous_holders", "sub_holders", "queue"))
_decode = msgspec.msgpack.Decoder(Sample | Observation).decode
#: One sample: the fields of `DeviceSamples` with as many numbers in every sample.
_ROW: Final[list[Any]] = [
    *((name, np.int64) for name in ("receive_ns", "capture_ns", "seq")),
    *((name, np.bool_) for name in ("tracked", "worn", "clutch")),
    *(("gripper", np.float64), ("buttons", np.int64), ("poses", np.float64, (7,)), ("twists", np.float64, (6,))),
]


def read_names(recording: Recording) -> dict[str, str]:
    """Return the newest name of each participant by its id.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    bodies = (event.body for event in recording.events())
    joined = (body.participant for body in bodies if isinstance(body, ParticipantJoined | ParticipantChanged))
    return {one.id: one.name for one in joined}


def list_event_records(recording: Recording) -> Iterator[dict[str, Any]]:
    """Yield the events as dictionaries of plain values.

    Args:
        recording: An open recording.

    Returns:
        Iterator over records: `event_seq`, `session_time_ns` (that of its step), `time_s` (the same [s]), `event` (its
        kind, such as `lease_changed`), and the fields of the event. Beside a field with the id of a participant stands
        `FIELD_name` with its name at that time, empty if it is not known: it joined in an earlier recording.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    names: dict[str, str] = {}
    for event in recording.events():
        if isinstance(event.body, ParticipantJoined | ParticipantChanged):
            names[event.body.participant.id] = event.body.participant.name
        yield make_event_record(event, names)


def make_event_record(event: Event, names: dict[str, str]) -> dict[str, Any]:
    """Return one event as a dictionary. `names`: of participants by id.

    `Event.step` is left out: the authority counts steps in another way than the journal, so that only times agree.
    """
    head: dict[str, Any] = {
        "event_seq": event.event_seq,
        "session_time_ns": event.session_time,
        "time_s": event.session_time * 1e-9,
    }
    fields: dict[str, Any] = _add_names(msgspec.to_builtins(event.body), names)
    return head | fields


def _add_names(value: Any, names: dict[str, str]) -> Any:
    """Return plain values with the names of participants beside their ids, also in what they contain."""
    if isinstance(value, list | tuple):
        return [_add_names(one, names) for one in value]
    if not isinstance(value, dict):
        return value
    out: dict[str, Any] = {}
    for key, one in value.items():
        out[key] = _add_names(one, names)
        if key in ID_FIELDS and isinstance(one, str):
            out[f"{key}_name"] = names.get(one, "")
        elif key in ID_LIST_FIELDS:
            out[f"{key}_names"] = [names.get(name, "") for name in one]
    return out


class DecodedSample(NamedTuple):
    """A sample with its sender. `participant`: id; it and `name` are empty if the join is not in this recording."""

    participant: str
    name: str
    receive_ns: int
    sample: Sample


class DeviceSamples(NamedTuple):
    """Raw samples of one device of one participant, in order of receipt; one row each.

    Attributes:
        receive_ns: Session time of receipt, shape (n,) int64.
        capture_ns: When they were sampled, session time by the client's clock, shape (n,) int64.
        seq: Their numbers, shape (n,) int64; they begin anew with a connection.
        tracked: The device was tracked, shape (n,) bool.
        worn: The headset was worn, shape (n,) bool.
        clutch: The target was to follow, shape (n,) bool.
        gripper: 0 open to 1 closed, shape (n,) float64; NaN: not given.
        buttons: Bit masks, shape (n,) int64.
        poses: `T_tracking_device`, `x y z qw qx qy qz` [m], shape (n, 7) float64; NaN without a pose.
        twists: `vx vy vz wx wy wz` [m/s, rad/s], tracking frame, shape (n, 6) float64; NaN without one.
        q: Joint positions of a leader [rad or m], shape (n, k) float64, k of the longest sample; NaN beyond.
        hand_joints: As in `Sample.hand_joints`, shape (n, m) float64; NaN in samples without.
    """

    receive_ns: NDArray[np.int64]
    capture_ns: NDArray[np.int64]
    seq: NDArray[np.int64]
    tracked: NDArray[np.bool_]
    worn: NDArray[np.bool_]
    clutch: NDArray[np.bool_]
    gripper: NDArray[np.float64]
    buttons: NDArray[np.int64]
    poses: NDArray[np.float64]
    twists: NDArray[np.float64]
    q: NDArray[np.float64]
    hand_joints: NDArray[np.float64]


def iterate_samples(recording: Recording) -> Iterator[DecodedSample]:
    """Yield the raw samples of all participants, decoded, in order of receipt.

    Messages that are no sample, or do not decode, are left out.

    Raises:
        NotARecordingError: A file can no longer be read.
    """
    owners, names = read_owners(recording), read_names(recording)
    for raw in recording.samples():
        try:
            message = _decode(raw.data)
        except BAD_BYTES:
            continue
        if isinstance(message, Sample):
            participant = owners.get(raw.connection, "")
            yield DecodedSample(participant, names.get(participant, ""), raw.receive_ns, message)


def read_device_samples(recording: Recording, participant: str, device: str) -> DeviceSamples:
    """Read the samples of one device of one participant.

    Args:
        recording: An open recording.
        participant: Name, which several may have one after the other, or id.
        device: Its device, for example `hand/left`.

    Returns:
        Its samples.

    Raises:
        RecordingError: There are none; the message lists the devices that have some.
        NotARecordingError: A file can no longer be read.
    """
    others: dict[str, None] = {}
    joints: list[tuple[float, ...]] = []
    hand_joints: list[tuple[float, ...]] = []

    def read() -> Iterator[tuple[Any, ...]]:
        for one in iterate_samples(recording):
            sample = one.sample
            if participant not in (one.participant, one.name) or sample.device != device:
                others.setdefault(f"{one.name or 'unknown'} {sample.device}")
                continue
            joints.append(sample.q)
            hand_joints.append(sample.hand_joints)
            gripper, *numbers = list_numbers(sample)
            flags = sample.tracked, sample.worn, sample.clutch
            head = one.receive_ns, sample.capture_ns, sample.seq, *flags, gripper, sample.buttons
            yield *head, numbers[:7], numbers[7:]

    rows = np.fromiter(read(), _ROW)
    if not len(rows):
        listed = ", ".join(others) or "none"
        raise RecordingError(f"there are no samples of {participant!r} {device!r}. Samples: {listed}")
    columns = {name: rows[name].copy() for name, *_ in _ROW}
    return DeviceSamples(**columns, q=_pad(joints), hand_joints=_pad(hand_joints))


_NO_POSE: Final = (np.nan,) * 7
_NO_TWIST: Final = (np.nan,) * 6


def list_numbers(sample: Sample) -> tuple[float, ...]:
    """Return gripper, pose and twist of a sample, 14 numbers; NaN for what it does not have."""
    pose = _NO_POSE if sample.pose is None else (*sample.pose.p, *sample.pose.q)
    gripper = np.nan if sample.gripper is None else sample.gripper
    return (gripper, *pose, *(sample.twist or _NO_TWIST))


def _pad(rows: list[tuple[float, ...]]) -> NDArray[np.float64]:
    """Return rows of different lengths as an array, NaN behind the shorter ones."""
    padded = np.full((len(rows), max(map(len, rows), default=0)), np.nan)
    for i, row in enumerate(rows):
        padded[i, : len(row)] = row
    return padded
