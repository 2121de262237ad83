"""Messages between the authority's feed and the recorder process. Pure.

Authority -> recorder: `HEADER` with the number of the batch that follows it, the header, and a batch with the scene
loaded last, if any, and the location of its assets; or `BATCH` with its own number, and the body; or `FLUSH` at the
end: the recorder collects nothing from then on. Recorder ->
authority: `RecorderStatus`. The feed keeps every batch until a status confirms that it is in the file; a new recorder
process requests the header (`expecting` -1) and receives everything that is not confirmed.

Point clouds and pictures of cameras have a socket of their own; the messages are in `front.media.recorder`.
"""

from __future__ import annotations

import struct
from typing import Final

import msgspec

from iris_session.journal.rows import JournalRow, Keyframe, SessionHeader
from iris_session.protocol.codec import make_decoder
from iris_session.protocol.common import Applied, Count, Denial, Name, Nanoseconds
from iris_session.protocol.server_messages import BodyInfo, Event, ParticipantInfo, PresenceItem

#: Prefix of the line on standard error with the reason why the recorder ended; other lines are Rerun's.
FAULT_PREFIX: Final = "recorder: "


class RecorderConfig(msgspec.Struct, frozen=True):
    """Configuration of the recorder process.

    `path`: the recording; `part`: number of the file to write, which must not exist. Endpoints: `ipc://` sockets that
    the recorder binds; without `media_endpoint` no point clouds and pictures are recorded. `origin_ns`: session time
    zero on CLOCK_MONOTONIC. `parent`: id of the parent process; the recorder ends after it, once the file is finished.
    `record_assets`: see `rrd/assets.py`. `budget_bytes`: see `budget.py`. `journal_only`: an error in the picture has
    ended the recorder before, and would come again: of batches only what verification needs is written, and no media.
    """

    path: str
    part: int
    recording_id: str
    feed_endpoint: str
    samples_endpoint: str
    origin_ns: int
    parent: int
    media_endpoint: str = ""
    record_assets: str = "none"
    budget_bytes: int = 0
    journal_only: bool = False


#: Description of `EndMark.is_abrupt`.
ABRUPT: Final = "session ended abruptly: its process was killed or crashed"


class EndMark(msgspec.Struct, frozen=True, array_like=True):
    """Mark at the end of a closed file: `step` and `chain` of its newest row.

    `reason`: why it ended before the session, one line for people; empty if it did not. `samples_left_out`: number of
    raw messages of clients that the recorder did not write; those that the front left out are not counted.
    `is_abrupt`: the session's process was killed or crashed, and the recorder closed the file by itself.
    """

    step: int
    chain: bytes
    reason: str = ""
    samples_left_out: Count = 0
    is_abrupt: bool = False


class HeaderCopy(msgspec.Struct, frozen=True, array_like=True):
    """Copy of a header without its model, which is most of it. `root`: `header_root` of the whole header."""

    root: bytes
    header: SessionHeader


HEADER: Final = b"H"
BATCH: Final = b"B"
FLUSH: Final = b"F"
FRAME: Final = struct.Struct("<cQ")  # kind, batch number


class StateFrame(msgspec.Struct, frozen=True, array_like=True):
    """Rigid state at one moment. `poses`: float64 (n_bodies, 7) C-contiguous, `x y z qw qx qy qz`, world frame.

    `robots`: measured values of the robots as in `physics.world.RobotSignals.read`, described by `SceneAssets.robots`.
    `sim_before`: by how much resets have set simulated time back, all together [s].
    """

    step: Count
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    poses: bytes
    presence: tuple[PresenceItem, ...] = ()
    applied: tuple[Applied, ...] = ()
    robots: bytes = b""
    sim_before: float = 0.0


class DenialRecord(msgspec.Struct, frozen=True, array_like=True):
    """A denial that a participant received."""

    step: Count
    session_time: Nanoseconds
    connection: Count
    denial: Denial


class MetricRecord(msgspec.Struct, frozen=True, array_like=True):
    """One scalar for the plots: lateness, latency."""

    step: Count
    session_time: Nanoseconds
    name: Name
    value: float


class SceneModel(msgspec.Struct, frozen=True, array_like=True):
    """Model of a scene that was loaded in a session; it is sent before the row that loads it.

    `step`, `session_time`: those of the newest row before that one. `model_hash`: as in `SceneLoaded`. `model`:
    `pack_model` of its binary form (mjb). `bodies`: the streamed bodies from then on.
    """

    step: int
    session_time: Nanoseconds
    model_hash: Name
    model: bytes
    bodies: tuple[BodyInfo, ...] = ()


class RobotLabels(msgspec.Struct, frozen=True, array_like=True):
    """Names of the values of one robot in `StateFrame.robots`. `units`: of the joints, `rad` or `m`."""

    name: Name
    base_body: Name
    joints: tuple[Name, ...] = ()
    units: tuple[Name, ...] = ()


class SceneAssets(msgspec.Struct, frozen=True, array_like=True):
    """Assets of the picture, valid from about `step`.

    `root`: folder of the asset store; `scene_hash`: asset that is the specification. If empty, no assets are shared
    and the picture is made from the model. `robots`: robots of the scene.
    """

    step: int = -1
    session_time: Nanoseconds = 0
    root: str = ""
    scene_hash: str = ""
    robots: tuple[RobotLabels, ...] = ()


class HoldRecord(msgspec.Struct, frozen=True, array_like=True):
    """A robot holds for another reason (`HoldReason`) from this step on, or moves (empty). For the picture only."""

    step: Count
    session_time: Nanoseconds
    robot: Name
    reason: Name


class VertexFrame(msgspec.Struct, frozen=True, array_like=True):
    """Vertices of one deformable as published with the state of `session_time`.

    `frame`: level `full` of its media stream, see docs/deformables.md.
    """

    stream: Name
    session_time: Nanoseconds
    frame: bytes


class Batch(msgspec.Struct, array_like=True):
    """Records of about 20 ms.

    `dropped_rows`: rows dropped before this batch since the feed began. `scenes` precede all other records of the
    batch, then `assets`: those of the newest of these scenes, or a patch of the present one. `people`: participants
    so far, for a recorder that starts later.
    """

    rows: list[JournalRow] = []
    states: list[StateFrame] = []
    events: list[Event] = []
    denials: list[DenialRecord] = []
    metrics: list[MetricRecord] = []
    keyframes: list[Keyframe] = []
    dropped_rows: Count = 0
    scenes: list[SceneModel] = []
    assets: list[SceneAssets] = []
    holds: list[HoldRecord] = []
    people: list[ParticipantInfo] = []
    vertices: list[VertexFrame] = []


class _Essence(msgspec.Struct, array_like=True):
    """The part of a `Batch` that verification needs, for a batch whose other parts break a limit of the protocol."""

    rows: list[JournalRow]
    states: msgspec.Raw
    events: msgspec.Raw
    denials: msgspec.Raw
    metrics: msgspec.Raw
    keyframes: list[Keyframe]
    dropped_rows: Count = 0
    scenes: list[SceneModel] = []


class RecorderStatus(msgspec.Struct, frozen=True, array_like=True):
    """Status of the recorder, sent after every write and at least every half second.

    `instance`: differs for every recorder process. `expecting`: number of the next batch, -1 until a header arrived.
    `written`: newest batch that is in the file, -1 for none. `bytes`: size of the file. `lag_ns`: age of the newest row
    when it was written. `samples`: number of raw messages received. `samples_refused`: number of invalid messages of
    the front, and of batches of which only the journal could be read. `fault`: one line if the file can no longer be
    written; the process then ends. `disk_free`: free bytes on its disk, at least 1; 0 if unknown. `vertices_refused`:
    number of vertex frames that are not in the picture: they do not decode or are of another scene. `samples_left_out`:
    raw messages that are not in the file, because time and room of the disk were left to the journal. `media_refused`:
    frames of point clouds and pictures that do not decode. `assets_left_out`: assets of the scenes that are not in the
    file. `budget`, `budget_left`: bytes that the recording may have, and that are left of them; 0, 0: any number.
    `ended`: the budget is used up, the file is closed and the process ends: nothing more is recorded.
    """

    instance: int
    expecting: int
    written: int
    bytes: int = 0
    lag_ns: int = 0
    samples: int = 0
    samples_refused: int = 0
    fault: str = ""
    disk_free: int = 0
    vertices_refused: int = 0
    samples_left_out: int = 0
    media_refused: int = 0
    assets_left_out: int = 0
    budget: int = 0
    budget_left: int = 0
    ended: bool = False


encode_batch = encode_scene = encode_header = encode_header_copy = encode_status = msgspec.msgpack.Encoder().encode
decode_batch = make_decoder(Batch)
_decode_essence = make_decoder(_Essence)
decode_scene = make_decoder(SceneModel)
decode_header = make_decoder(SessionHeader)
decode_header_copy = make_decoder(HeaderCopy)
decode_status = make_decoder(RecorderStatus)


def decode_journal(data: bytes) -> Batch:
    """Decode the part of a batch that verification needs, if `decode_batch` fails. Raises `msgspec.DecodeError`."""
    essence = _decode_essence(data)
    return Batch(rows=essence.rows, keyframes=essence.keyframes, scenes=essence.scenes)
