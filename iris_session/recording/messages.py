"""What travels between the authority's feed and the recorder process. Pure.

Authority -> recorder: `HEADER` with the number of the batch that follows it, the header, and a batch that says which
scene was loaded last, if one was, and where its assets lie; or `BATCH` with its own number, and the body. Recorder ->
authority: `RecorderStatus`. The feed keeps every batch until a status says that it is in the file; a new recorder
process asks for the header (`expecting` -1) and gets everything since.

Beside it, by a socket of their own that forgets what does not fit: `VertexFrame`, for the picture only.
"""

from __future__ import annotations

import struct
from typing import Final

import msgspec

from iris_session.protocol.codec import make_decoder
from iris_session.protocol.common import Applied, Count, Denial, Name, Nanoseconds
from iris_session.protocol.server_messages import BodyInfo, Event, PresenceItem
from iris_session.recording.journal import JournalRow, Keyframe, SessionHeader

#: Begins the line on standard error that says why the recorder ended; other lines are Rerun's.
FAULT_PREFIX: Final = "recorder: "


class RecorderConfig(msgspec.Struct, frozen=True):
    """Configuration of the recorder process.

    `path`: the recording; `part`: which of its files to begin with, none of them may exist. Endpoints: `ipc://` sockets
    that it binds. `origin_ns`: session time zero on CLOCK_MONOTONIC. `parent`: process that it outlives only to finish.
    Without `vertices_endpoint` nothing bends.
    """

    path: str
    part: int
    recording_id: str
    feed_endpoint: str
    samples_endpoint: str
    origin_ns: int
    parent: int
    vertices_endpoint: str = ""


class EndMark(msgspec.Struct, frozen=True, array_like=True):
    """The last thing in a file that was closed. `step`, `chain`: of its newest row."""

    step: int
    chain: bytes


HEADER: Final = b"H"
BATCH: Final = b"B"
FRAME: Final = struct.Struct("<cQ")  # kind, batch number


class StateFrame(msgspec.Struct, frozen=True, array_like=True):
    """Rigid state at one moment. `poses`: float64 (n_bodies, 7) C-contiguous, `x y z qw qx qy qz`, world frame."""

    step: Count
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    poses: bytes
    presence: tuple[PresenceItem, ...] = ()
    applied: tuple[Applied, ...] = ()


class DenialRecord(msgspec.Struct, frozen=True, array_like=True):
    """A typed no that a participant got."""

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
    """The model of a scene that was loaded in a session; it comes before the row that loads it.

    `step`, `session_time`: of the newest row before that one. `model_hash`: as in `SceneLoaded`. `model`: `pack_model`
    of its binary form (mjb). `bodies`: the streamed bodies from then on.
    """

    step: int
    session_time: Nanoseconds
    model_hash: Name
    model: bytes
    bodies: tuple[BodyInfo, ...] = ()


class SceneAssets(msgspec.Struct, frozen=True, array_like=True):
    """What the picture is drawn from, since about `step`: the store `root` has the specification, which is its asset
    `scene_hash`, and all others. Empty: nothing is shared, and the picture is made of the model.
    """

    step: int = -1
    session_time: Nanoseconds = 0
    root: str = ""
    scene_hash: str = ""


class VertexFrame(msgspec.Struct, frozen=True, array_like=True):
    """Vertices of one deformable as they were published with the state of `session_time`. `frame`: `full` of its media
    stream, see docs/deformables.md."""

    stream: Name
    session_time: Nanoseconds
    frame: bytes


class Batch(msgspec.Struct, array_like=True):
    """Everything of about 20 ms. `dropped_rows`: rows lost before this batch since the feed began. `scenes` come before
    everything else in it, then `assets`: of the newest of these scenes, or a patch of the present one."""

    rows: list[JournalRow] = []
    states: list[StateFrame] = []
    events: list[Event] = []
    denials: list[DenialRecord] = []
    metrics: list[MetricRecord] = []
    keyframes: list[Keyframe] = []
    dropped_rows: Count = 0
    scenes: list[SceneModel] = []
    assets: list[SceneAssets] = []


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
    """Sent after every write, and at least every half second. `written`: newest batch that is in the file, -1 for none.

    `expecting`: number of the next batch, -1 until a header came. `cpu_ns`: processor time of the recorder so far.
    `lag_ns`: age of the newest row when it was written. `samples_refused`: messages of the front that are none, and
    batches of which only the journal could be read. `vertices_refused`: frames of vertices that are not in the picture,
    because too many waited, they do not decode, or are of another scene.
    `fault`: one line when the file can no longer be written; the process then ends. `disk_free`: bytes that its disk
    has left, at least 1, 0 when that is not known.
    """

    instance: int
    expecting: int
    written: int
    bytes: int = 0
    cpu_ns: int = 0
    lag_ns: int = 0
    samples: int = 0
    samples_refused: int = 0
    fault: str = ""
    disk_free: int = 0
    vertices_refused: int = 0


encode_batch = msgspec.msgpack.Encoder().encode
decode_batch = make_decoder(Batch)
_decode_essence = make_decoder(_Essence)
encode_scene = msgspec.msgpack.Encoder().encode
decode_scene = make_decoder(SceneModel)
encode_vertices = msgspec.msgpack.Encoder().encode
decode_vertices = make_decoder(VertexFrame)
encode_header = msgspec.msgpack.Encoder().encode
decode_header = make_decoder(SessionHeader)
encode_status = msgspec.msgpack.Encoder().encode
decode_status = make_decoder(RecorderStatus)


def decode_journal(data: bytes) -> Batch:
    """What verification needs of a batch that `decode_batch` cannot read as a whole. Raises `msgspec.DecodeError`."""
    essence = _decode_essence(data)
    return Batch(rows=essence.rows, keyframes=essence.keyframes, scenes=essence.scenes)
