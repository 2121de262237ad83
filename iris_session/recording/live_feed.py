"""Send a recording that is being written to a viewer: `python -m iris_session.recording.live_feed FILE ADDRESS`.

It reads whole messages from the end of the file and hands them to Rerun's client. So the recorder knows nothing of
viewers: one that does not read makes this process wait, and what it has not got is in the file. Then the next part
follows. The process ends with the session, or with the process that started it.

The recorder writes rows of motion once a second, and exact states several times a second: of these the newest one is
drawn beside what the file has.

Rerun's own server (`GrpcServerSink`) would have to run in the recorder of every session, beside its encoder: it takes
the same data in a second stream, and forgets the oldest of it first, which is the scene.

The viewer opens on the newest moment, where a recording opens at the first: the arrangement of views is sent with
another play state.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

from iris_session.journal.errors import NotARecordingError
from iris_session.recording.lock import is_being_written
from iris_session.rrd import paths
from iris_session.rrd.file import (
    BLUEPRINT,
    END_MESSAGE,
    FILE_HEAD,
    KIND_ARROW,
    KIND_END,
    KIND_LAST,
    KIND_STORE_INFO,
    MAGIC,
    RECORDING,
    find_store_id,
    read_chunks,
    read_message,
    read_message_head,
    scan_file,
)
from iris_session.system.process import die_with_parent

#: How often the file is read, and the most bytes that are sent at once.
POLL_S: Final = 0.1
BATCH_BYTES: Final = 2 << 20
#: How long one attempt to send lasts; it is repeated until the viewer takes what it got.
SEND_S: Final = 0.5
#: After this long without a writer and without new bytes the session has ended.
ENDED_S: Final = 2.0
_KIND_ACTIVATION: Final = 3
_HEAD_BYTES: Final = len(END_MESSAGE)


class MessageTail:
    """Reader of the whole messages of a file that grows, and of the parts after it."""

    def __init__(self, path: str) -> None:
        self._base, self._part = paths.split_part(path)
        self._file: BinaryIO | None = None
        self._at = 0
        self.head = b""  # of the present file

    def read(self, n_bytes: int) -> list[bytes]:
        """Return the next messages of one file, about `n_bytes` at most; none if none is complete.

        Raises:
            NotARecordingError: The file is not one that a recorder writes.
        """
        if self._file is None and not self._open():
            return []
        assert self._file is not None
        found: list[bytes] = []
        while n_bytes > 0 and (message := self._read_message()):
            found.append(message)
            n_bytes -= len(message)
            self._at += len(message)
        if not found and os.path.exists(paths.part_path(self._base, self._part + 1)):  # its recorder has ended
            self.close()
            self._part += 1
        return found

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _open(self) -> bool:
        path = paths.part_path(self._base, self._part)
        with suppress(FileNotFoundError):
            file = open(path, "rb")  # noqa: SIM115 - closed by `read`
            self.head = file.read(FILE_HEAD)
            if self.head.startswith(MAGIC) and len(self.head) == FILE_HEAD:
                self._file, self._at = file, FILE_HEAD
                return True
            file.close()
            if self.head and not MAGIC.startswith(self.head[: len(MAGIC)]):
                raise NotARecordingError(f"{path} is not a Rerun file")
        return False

    def _read_message(self) -> bytes:
        """Return the next message, empty if it is not complete or the file was closed."""
        assert self._file is not None
        self._file.seek(self._at)
        head = self._file.read(_HEAD_BYTES)
        if len(head) < _HEAD_BYTES:
            return b""
        kind, length = read_message_head(head)
        if kind > KIND_LAST:
            raise NotARecordingError(f"{self._file.name} cannot be followed: byte {self._at} begins no message")
        if kind == KIND_END:
            return b""
        body = self._file.read(length)
        return head + body if len(body) == length else b""


class LiveFeed:
    """Sender of a recording that is being written to a viewer at `url`."""

    def __init__(self, path: str, url: str) -> None:
        self._tail = MessageTail(path)
        self._url = url
        self._client: Any = None
        self._motion = LiveMotion()
        self._infos: dict[bytes, bytes] = {}  # by id of the store: what every batch begins with

    def poll(self) -> int:
        """Send what was written since the last call, at most `BATCH_BYTES`. Return the number of bytes.

        Waits for a viewer that does not take it.
        """
        messages = self._tail.read(BATCH_BYTES)
        if not messages:
            return 0
        data = [self._tail.head, *self._infos.values()]
        for message in messages:
            kind, _ = read_message_head(message)
            if kind == KIND_STORE_INFO:
                self._infos[find_store_id(message, RECORDING) or find_store_id(message, BLUEPRINT)] = message
            elif kind == _KIND_ACTIVATION:
                data.append(_make_following(find_store_id(message, BLUEPRINT)))
            data.append(message)
        self._send(b"".join((*data, END_MESSAGE)))
        return sum(map(len, messages))

    def close(self) -> None:
        """Close the file. What was sent is on its way."""
        self._tail.close()

    def _send(self, data: bytes) -> None:
        import rerun as rr

        if self._client is None:
            # Rerun's importer sends messages under their own ids; this one is the same, so that no other one appears.
            own_id = next(iter(self._infos), b"").decode()
            self._client = rr.RecordingStream(paths.APPLICATION, recording_id=own_id)
            self._client.set_log_time_enabled(False)
            self._client.connect_grpc(self._url)
        self._client.log_file_from_contents(paths.FIRST_FILE, data)
        self._motion.draw(self._client, data)
        while True:
            with suppress(RuntimeError):
                self._client.flush(timeout_sec=SEND_S)
                return


class LiveMotion:
    """Poses of bodies and devices at the newest state of a recording that is being written."""

    def __init__(self) -> None:
        self._entities: list[str] = []

    def draw(self, client: Any, data: bytes) -> None:
        """Draw the newest state in the bytes of a file, if one is in them."""
        from iris_session.rrd import batches
        from iris_session.viewer.participant_layer import get_device_entity
        from iris_session.viewer.timelines import Moment, set_moment

        newest = None
        with tempfile.NamedTemporaryFile(suffix=".rrd") as file, suppress(NotARecordingError):
            file.write(data)
            file.flush()
            for chunk in read_chunks(file.name, (paths.STATE, paths.STATE_ENTITIES)):
                batch = chunk.to_record_batch()
                if chunk.entity_path == paths.STATE_ENTITIES:
                    self._entities = batch.column("bodies")[-1].as_py()
                else:
                    newest = batch.slice(batch.num_rows - 1)
        if newest is None:
            return
        (state,) = batches.decode_states(newest)
        (sim_ns,), (wall_ns,) = (batches.read_index(newest, name) for name in (paths.SIM_TIME, paths.WALL_TIME))
        set_moment(client, Moment(state.step, sim_ns, state.session_time, wall_ns))
        if len(state.poses) == len(self._entities):
            for entity, pose in zip(self._entities, state.poses.tolist(), strict=True):
                if entity:
                    _draw_pose(client, entity, pose)
        for item in state.presence:
            _draw_pose(client, get_device_entity(item.participant, item.device), [*item.pose.p, *item.pose.q])
        client.reset_time()


def _draw_pose(client: Any, entity: str, pose: list[float]) -> None:
    """Log a pose `x y z qw qx qy qz`."""
    import rerun as rr

    x, y, z, qw, *q = pose
    client.log(entity, rr.Transform3D(translation=(x, y, z), quaternion=rr.Quaternion(xyzw=[*q, qw])))


def _make_following(blueprint: bytes) -> bytes:
    """Return a message for the blueprint of this id that makes the viewer follow the newest moment.

    The newest static value counts, so it must be made after the blueprint.
    """
    import rerun.blueprint as rrb
    from rerun.blueprint.api import create_in_memory_blueprint
    from rerun.chunk import RrdReader

    panel = rrb.TimePanel(play_state="following")
    memory = create_in_memory_blueprint(application_id=paths.APPLICATION, blueprint=rrb.Blueprint(panel))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder, "panel.rrd")
        path.write_bytes(memory.storage.concat_as_bytes())
        reader = RrdReader(str(path))
        chunks = [chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[0])]
        messages = [message for message in scan_file(path).messages if message.kind == KIND_ARROW]
        for chunk, message in zip(chunks, messages, strict=True):
            if "TimePanelBlueprint:play_state" in chunk.schema.names:
                with open(path, "rb") as file:
                    data = read_message(file, message)
                own = find_store_id(data, BLUEPRINT)
                return data.replace(own, blueprint) if len(own) == len(blueprint) else b""
    return b""


def follow(path: str, url: str, parent: int) -> None:
    """Send a recording to a viewer until the session has ended, or the process `parent` has."""
    feed, quiet_s = LiveFeed(path, url), time.monotonic()
    while os.getppid() == parent:
        if feed.poll():
            quiet_s = time.monotonic()
            continue
        if time.monotonic() - quiet_s > ENDED_S and not is_being_written(paths.split_part(path)[0]):
            return
        time.sleep(POLL_S)


def main() -> int:
    """Follow the file of the command line."""
    die_with_parent(signal.SIGTERM)  # also while a viewer takes nothing
    try:
        follow(sys.argv[1], sys.argv[2], os.getppid())
    except NotARecordingError as error:
        print(f"iris-session: {error}", file=sys.stderr)
        return 1
    os._exit(0)  # Rerun's client would wait for a viewer that is gone


if __name__ == "__main__":
    sys.exit(main())
