"""The recorder process: `python -m iris_session.recording.process`, configuration as MessagePack on standard input.

Receives batches from the authority and raw samples from the front, and writes them into one Rerun file about seven
times a second, so that killing any process loses at most 0.25 s; of a scene at rest every two seconds. The journal
comes first: raw samples are left out, and counted, while the disk is slow or nearly full, and media when time is short.
Prints `ready` or `failed: <one line>` on standard output. Ends on SIGTERM, or when its parent process has ended, after
writing everything that was received, and when the budget of the recording is used up; SIGINT is left to the parent.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec
import zmq

from iris_session.journal.errors import RecorderError, WriteError
from iris_session.journal.messages import (
    BATCH,
    FAULT_PREFIX,
    FLUSH,
    FRAME,
    HEADER,
    Batch,
    RecorderConfig,
    RecorderStatus,
    decode_batch,
    decode_header,
    decode_journal,
    encode_status,
)
from iris_session.journal.rows import SessionHeader
from iris_session.protocol.common import Name
from iris_session.protocol.status import ClientReport
from iris_session.recording.budget import RecordingBudget, describe_used_budget
from iris_session.recording.lock import TRIED_S, RecordingLock
from iris_session.recording.supervise import FINISH_SIGNAL
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.assets import AssetQueue
from iris_session.rrd.index import start_indexing
from iris_session.rrd.paths import part_path
from iris_session.system.log import configure_logging

#: Period at which sockets are drained, instead of at every message: one wake-up for some twenty messages.
DRAIN_S: Final = 0.03
FLUSH_S: Final = 0.14
#: The same while the scene is at rest: a chunk of the file is mostly its schema.
REST_FLUSH_S: Final = 1.9
SYNC_S: Final = 1.0
STATUS_S: Final = 0.5
#: Maximum number of messages per drain, so that a flood cannot keep the file from being written.
DRAIN_MESSAGES: Final = 4096
#: Maximum number of batches of raw samples per drain (64 KiB each).
DRAIN_SAMPLES: Final = 64
#: Maximum number of point clouds and pictures per drain, so sixty a second.
DRAIN_MEDIA: Final = 2
#: After SIGTERM or the end of the parent: without a message for this long, everything was received.
QUIET_S: Final = 0.1
FINISH_S: Final = 10.0
#: An orphaned recorder whose file does not grow for this long exits: a write to a hung disk never returns.
ORPHAN_S: Final = 20.0
#: Exit statuses. An error that nothing catches is 1 (`supervise.CRASHED`).
NOT_BEGUN: Final = 2
NOT_WRITTEN: Final = 3
ORPHANED: Final = 4
MIN_FREE_BYTES: Final = 16 << 20
#: Free bytes that are left to the journal: hours of it. Below, raw samples, vertices and media are left out.
JOURNAL_RESERVE_BYTES: Final = 256 << 20
#: A write that takes longer shows a disk that cannot keep up: raw samples are left out until one is shorter. Drawing a
#: scene or a busy processor makes a flush long, but not this.
SLOW_WRITE_S: Final = 0.3
#: Bytes written to test a new file. A file begins with about 22 KB, mostly the blueprint.
TRIAL_BYTES: Final = 128 << 10
#: Bytes of assets in a write: at most, at least, and what the disk takes in `ASSETS_S`.
MAX_ASSETS_BYTES: Final = 1 << 20
MIN_ASSETS_BYTES: Final = 64 << 10
ASSETS_S: Final = 0.02
#: Time for the rest of the assets when the session ends: all ends within 2 s after Ctrl-C (docs/recovery.md).
ASSETS_AT_END_S: Final = 1.5

_decode_samples = msgspec.msgpack.Decoder(list[tuple[int, int, bytes]]).decode
#: First byte of a report in place of a message: an array of two, where messages are maps.
_REPORT: Final = b"\x92"
_decode_report = msgspec.msgpack.Decoder(tuple[Name, ClientReport]).decode


class RecorderLoop:
    """Main loop of the recorder process. `stop` may be called from a signal handler."""

    def __init__(self, config: RecorderConfig) -> None:
        # Another process may continue this recording: then no part is begun. Its first file may have been moved away.
        is_there = config.part > 1 and os.path.exists(config.path)
        lock = RecordingLock(config.path, shared=True, patience_s=TRIED_S) if is_there else None
        self._config = config
        self._context = zmq.Context(io_threads=1)
        self._feed = self._bind(zmq.DEALER, config.feed_endpoint)
        self._front = self._bind(zmq.PULL, config.samples_endpoint, DRAIN_SAMPLES)
        self._media = self._bind(zmq.PULL, config.media_endpoint, DRAIN_MEDIA) if config.media_endpoint else None
        self._budget = RecordingBudget(config.budget_bytes, config.path, config.part)
        self._begin_part()
        self._lock = lock if config.part > 1 else RecordingLock(config.path, shared=True, patience_s=TRIED_S)
        self._header: SessionHeader | None = None
        self._instance = time.monotonic_ns()  # differs from that of every earlier recorder
        self._expecting = -1
        self._received = self._written = -1
        self._newest_ns = 0  # session time of the newest row received
        self._lag_ns = 0
        self._samples = 0
        self._samples_left_out = 0
        self._disk_free = get_free_bytes(Path(self._writer.path))
        self._write_s = 0.0  # duration of the last write of a flush
        self._refused = 0
        self._unwritten_bytes = 0  # of the journal, since the last write
        self._assets_bytes = MAX_ASSETS_BYTES  # of assets in the next write
        self._is_used_up = False  # the budget
        self._ended = False
        self._fault = ""
        self._stopping = self._is_ending = False
        self._flush_at = self._rest_at = self._status_at = 0.0  # on the monotonic clock [s]
        self._has_news = False  # something was received since the last write

    def run(self) -> int:
        """Record until stopped. Return the exit status of the process."""
        has_ended = threading.Event()
        threading.Thread(target=self._give_up_as_orphan, args=(has_ended,), name="orphan", daemon=True).start()
        try:
            self._send_status(-1)
            self._loop()
            if not self._is_used_up:
                self._drain_all()
            self._close_file()
            self._syncer.sync()
            self._send_status(self._received)
            if self._header is None:
                self._remove()
            else:
                with suppress(OSError):  # without an index the file opens more slowly
                    self._indexing = start_indexing(self._writer.path, self._budget.max_bytes)
        except WriteError as error:
            self._fault = str(error)
            self._send_status(-1)
            sys.stderr.write(f"{FAULT_PREFIX}{self._fault}\n")
            return NOT_WRITTEN
        finally:
            self._syncer.stop()
            self._context.destroy(linger=500)
            if os.getppid() != self._config.parent:  # the parent was killed: it cannot remove the folder
                shutil.rmtree(Path(self._config.feed_endpoint.removeprefix("ipc://")).parent, ignore_errors=True)
            has_ended.set()
        return 0

    def _close_file(self) -> None:
        """Write the assets that wait, as far as time and room permit, and close the file."""
        until = time.monotonic() + ASSETS_AT_END_S
        self._writer.assets.is_ending = True
        while self._writer.assets and time.monotonic() < until and not self._is_used_up and not self._is_short:
            before = self._writer.stream.size
            self._writer.write_assets(MAX_ASSETS_BYTES)
            if self._writer.stream.size == before:
                break  # there was no step
        reason = describe_used_budget(self._budget.total_bytes) if self._is_used_up else ""
        is_abrupt = not self._stopping and os.getppid() != self._config.parent
        self._writer.close(reason=reason, samples_left_out=self._samples_left_out, is_abrupt=is_abrupt)
        self._ended = self._is_used_up

    def _give_up_as_orphan(self, has_ended: threading.Event) -> None:
        """Exit the process when its parent has ended and the file cannot be written (runs in a thread)."""
        size, since = -1, time.monotonic()
        while not has_ended.wait(SYNC_S):
            try:
                now = os.stat(self._writer.path).st_size
            except OSError:
                now = size
            if now != size or os.getppid() == self._config.parent:
                size, since = now, time.monotonic()
            elif time.monotonic() - since > ORPHAN_S:
                os._exit(ORPHANED)

    def _remove(self) -> None:
        """Remove file and folder of a session that never began (its port was in use)."""
        path = Path(part_path(self._config.path, self._config.part))
        path.unlink(missing_ok=True)
        if self._made_folder:
            with suppress(OSError):
                path.parent.rmdir()

    def stop(self) -> None:
        """Ask the loop to finish the file."""
        self._stopping = True

    def _begin_part(self) -> None:
        path = part_path(self._config.path, self._config.part)
        self._made_folder = claim_file(Path(path))
        try:
            assets = AssetQueue(self._config.record_assets, self._budget.assets_bytes)
            self._writer = RrdWriter(path, self._config.recording_id, assets)
            self._writer.flush()
            self._syncer = _Syncer(path)
        except WriteError:
            self._remove()  # the next attempt uses the same number
            raise
        except (OSError, RuntimeError, ValueError) as error:
            self._remove()
            raise WriteError(f"{path} cannot be written: {error}") from error

    def _bind(self, kind: int, endpoint: str, messages: int = 20_000) -> zmq.Socket[bytes]:
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.RCVHWM, messages)
        socket.setsockopt(zmq.SNDHWM, 100)
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            raise RecorderError(f"the recorder cannot listen on {endpoint}: {error}") from error
        return socket

    def _loop(self) -> None:
        while not self._stopping and not self._is_used_up and os.getppid() == self._config.parent:
            time.sleep(DRAIN_S)
            self._has_news = bool(self._drain()) or self._has_news
            self._write_due(time.monotonic())

    def _write_due(self, now_s: float) -> None:
        """Write what was received, and report, each when it is due."""
        if now_s >= self._flush_at and (now_s >= self._rest_at or self._is_urgent):
            self._flush_at, self._rest_at = now_s + FLUSH_S, now_s + REST_FLUSH_S
            self._flush()
            self._write_s = self._writer.stream.write_s
            self._syncer.check()
            self._write_assets()
            self._lag_ns = time.monotonic_ns() - self._config.origin_ns - self._newest_ns
            self._status_at = now_s if self._has_news else self._status_at
            self._has_news = False
        if now_s >= self._status_at:
            self._status_at = now_s + STATUS_S
            self._send_status(self._written)

    def _drain_all(self) -> None:
        until = time.monotonic() + FINISH_S
        quiet_at = time.monotonic() + QUIET_S
        while time.monotonic() < min(until, quiet_at):
            if self._drain():
                quiet_at = time.monotonic() + QUIET_S
                self._flush()
                self._send_status(self._written)
            time.sleep(DRAIN_S)

    def _flush(self) -> None:
        self._writer.flush()
        self._unwritten_bytes = 0
        self._written = self._received

    @property
    def _is_urgent(self) -> bool:
        """True if what was received is to be written soon; rows of a scene at rest wait for others."""
        return self._writer.is_urgent or self._is_ending or bool(self._writer.assets)

    def _write_assets(self) -> None:
        """Write assets after the journal, as many as the disk takes in a moment: no row waits for them longer."""
        if not self._writer.assets or self._is_short:
            return
        began, before = time.monotonic(), self._writer.stream.size
        self._writer.write_assets(self._assets_bytes)
        bytes_per_s = (self._writer.stream.size - before) / max(1e-6, time.monotonic() - began)
        self._assets_bytes = max(MIN_ASSETS_BYTES, min(MAX_ASSETS_BYTES, round(bytes_per_s * ASSETS_S)))

    def _drain(self) -> int:
        n = 0
        while n < DRAIN_MESSAGES and int(self._feed.get(zmq.EVENTS)) & zmq.POLLIN:
            self._process_message(self._feed.recv_multipart(zmq.NOBLOCK))
            n += 1
        m = 0
        while m < DRAIN_SAMPLES:
            try:
                data = self._front.recv(zmq.NOBLOCK)
            except zmq.Again:
                break
            m += 1
            self._process_samples(data)
        if n < DRAIN_MESSAGES and m < DRAIN_SAMPLES and not (self._is_short or self._config.journal_only):
            # Else behind with more important data: media are dropped at their source.
            self._drain_media()
        return n + m

    @property
    def _is_short(self) -> bool:
        """True while time or room of the disk are left to the journal."""
        if self._write_s > SLOW_WRITE_S or 0 < self._disk_free < JOURNAL_RESERVE_BYTES:
            return True
        return self._budget.is_short(self._writer.size_with_index)

    def _drain_media(self) -> None:
        if self._media is None:
            return
        for _ in range(DRAIN_MEDIA):
            try:
                self._writer.add_media(self._media.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                return

    def _process_message(self, frames: list[bytes]) -> None:
        """Process a header or a batch. Batches count in order only; those before the header are sent again after it."""
        if len(frames) not in (2, 3) or len(frames[0]) != FRAME.size:
            self._refused += 1
            return
        kind, number = FRAME.unpack(frames[0])
        if kind == HEADER and self._expecting < 0:
            self._header = decode_header(frames[1])
            self._writer.write_header(self._header)
            for known in frames[2:]:
                self._writer.add(self._decode(known))
            self._expecting = number
            self._received = number - 1
        elif kind == FLUSH:
            self._is_ending = True
        elif kind == BATCH and number == self._expecting and not self._is_used_up:
            self._unwritten_bytes += len(frames[1])
            if self._budget.is_used_up(self._writer.size_with_index + self._unwritten_bytes):
                self._is_used_up = True
                return
            batch = self._decode(frames[1])
            if batch.vertices and self._is_short:
                self._writer.drawing.vertices_refused += len(batch.vertices)
                batch.vertices.clear()
            if batch.rows:
                self._newest_ns = batch.rows[-1].now_ns
            self._writer.add(batch)
            self._received = number
            self._expecting = number + 1

    def _decode(self, body: bytes) -> Batch:
        """Decode a batch, or only its journal if the rest is invalid or has ended a recorder: each next one gets it."""
        if not self._config.journal_only:
            with suppress(msgspec.ValidationError):
                return decode_batch(body)
        self._refused += 1
        return decode_journal(body)

    def _process_samples(self, data: bytes) -> None:
        try:
            samples = _decode_samples(data)
        except msgspec.DecodeError:
            self._refused += 1
            return
        self._samples += len(samples)
        if self._is_short:
            self._samples_left_out += len(samples)
            return
        for connection, receive_ns, message in samples:
            if message[:1] == _REPORT:
                self._process_report(receive_ns, message)
            else:
                self._writer.add_sample(connection, receive_ns, message)

    def _process_report(self, receive_ns: int, data: bytes) -> None:
        """Process what a participant says of the states that reach it; for the plots, no raw message."""
        self._samples -= 1
        try:
            participant, report = _decode_report(data)
        except msgspec.DecodeError:
            self._refused += 1
            return
        if report.delivered and report.age_ms_p99 > 0.0:  # 0: all frames were sent again, and have no age
            self._writer.add_report(participant, receive_ns, report.age_ms_p99)

    def _send_status(self, written: int) -> None:
        self._disk_free = get_free_bytes(Path(self._writer.path))
        status = RecorderStatus(
            self._instance,
            self._expecting,
            written,
            self._writer.stream.size,
            self._lag_ns,
            self._samples,
            self._refused,
            self._fault,
            self._disk_free,
            self._writer.drawing.vertices_refused,
            self._samples_left_out,
            self._writer.drawing.media_refused,
            self._writer.assets.left_out,
            self._budget.total_bytes,
            self._budget.count_left(self._writer.size_with_index),
            self._ended,
        )
        with suppress(zmq.Again):
            self._feed.send(encode_status(status), zmq.NOBLOCK)


class _Syncer:
    """Thread that syncs the file to disk once a second, so that a slow disk delays no write. Rerun never syncs.

    It also checks that the file still exists: data written into a removed file is lost without an error.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._ended = threading.Event()
        self._fault = ""
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Check the last sync. Raises `WriteError` if the disk reported an error or the file was removed."""
        if self._fault:
            raise WriteError(self._fault)

    def sync(self) -> None:
        """Sync the file now. Raises `WriteError` as `check` does."""
        try:
            os.fsync(self._fd)
            removed = os.fstat(self._fd).st_nlink == 0
        except OSError as error:
            raise WriteError(f"the recording cannot be made durable: {error.strerror}") from error
        if removed:
            raise WriteError(f"{self._path} was removed while it was being written")

    def stop(self) -> None:
        self._ended.set()
        self._thread.join(timeout=5.0)
        with suppress(OSError):
            os.fsync(self._fd)
        os.close(self._fd)

    def _run(self) -> None:
        while not self._ended.wait(SYNC_S):
            try:
                self.sync()
            except WriteError as error:
                self._fault = str(error)
                return


def claim_file(path: Path) -> bool:
    """Create the folder and the empty file. Return whether the folder was created.

    Raises `RecorderError`: permission denied, no space, or the file exists.
    """
    if os.path.exists(path):
        raise RecorderError(f"{path} exists, and recordings are never overwritten: choose another file")
    made_folder = not os.path.exists(path.parent)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _try_to_write(path)
        free = os.statvfs(path.parent)
    except OSError as error:
        raise RecorderError(f"cannot record to {path}: {error.strerror or error}") from error
    if free.f_bavail * free.f_frsize < MIN_FREE_BYTES:
        path.unlink(missing_ok=True)
        raise RecorderError(f"cannot record to {path}: less than {MIN_FREE_BYTES >> 20} MiB of the disk are free")
    return made_folder


def _try_to_write(path: Path) -> None:
    """Create the empty file after a trial write of `TRIAL_BYTES`, so that errors appear before the session begins."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        left = bytes(TRIAL_BYTES)
        while left:
            left = left[os.write(fd, left) :]
        os.ftruncate(fd, 0)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(fd)


def get_free_bytes(path: Path) -> int:
    """Return the free bytes on the disk of `path`, at least 1; 0 if unknown."""
    try:
        free = os.statvfs(path)
    except OSError:
        return 0
    return max(1, free.f_bavail * free.f_frsize)


def report_used_budget(config: RecorderConfig) -> int:
    """Say that nothing more is recorded, and begin no file: the recorder before was killed as it was to say so."""
    print("ready", flush=True)
    with zmq.Context() as context, context.socket(zmq.DEALER) as feed:
        feed.setsockopt(zmq.LINGER, 500)
        feed.setsockopt(zmq.SNDTIMEO, round(FINISH_S * 1e3))
        feed.bind(config.feed_endpoint)
        with suppress(zmq.Again):
            feed.send(
                encode_status(RecorderStatus(time.monotonic_ns(), -1, -1, budget=config.budget_bytes, ended=True))
            )
    return 0


def main() -> int:
    """Run the recorder process."""
    configure_logging()
    # A service manager, or one that frees memory, sends SIGTERM to all processes: the session ends this one when its
    # last row is here, and a file that ends before is not called finished.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    config = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=RecorderConfig)
    if RecordingBudget(config.budget_bytes, config.path, config.part).is_used_up(0):
        return report_used_budget(config)
    try:
        recorder = RecorderLoop(config)
    except (RecorderError, WriteError) as error:
        print(f"failed: {error}", flush=True)
        sys.stderr.write(f"{FAULT_PREFIX}{error}\n")
        return NOT_BEGUN
    signal.signal(FINISH_SIGNAL, lambda *_: recorder.stop())
    print("ready", flush=True)
    return recorder.run()


if __name__ == "__main__":
    sys.exit(main())
