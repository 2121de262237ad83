"""Resuming a session from its recording: the newest file, its last keyframe, and the rows after it, replayed.

The restored state is exactly that after the last row that replays with the same result. What comes after it (a file cut
short, a step that crashed, rows that other versions of the libraries compute differently) is left out and reported.

`resume.tokens` beside a recording holds data of a running session that no journal has: the state of its front (hashes
of resume tokens, connection numbers) and its addresses. Only its owner can read it. A thread writes it whenever it
changes, as a whole and durably, so a disk that hangs delays no step.
"""

from __future__ import annotations

import dataclasses
import errno
import itertools
import logging
import os
import socket
import stat
import threading
import time
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import mujoco

from iris_session.control import ControlError
from iris_session.journal.environment import read_boot_id, use_one_blas_thread
from iris_session.journal.rows import CRASHED, check_keyframe, is_result
from iris_session.journal.verification import Models
from iris_session.physics import (
    PhysicsError,
    compute_scene_hash,
    encode_model,
    find_objects,
    load_model,
)
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.protocol.entries import decode_entries
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.recording import (
    CLOSED,
    Continues,
    JournalRow,
    Keyframe,
    NotARecordingError,
    Recording,
    RecordingError,
    RecordingLock,
    SessionHeader,
    check_row,
)
from iris_session.recording.folders import find_session_in
from iris_session.recording.lock import PATIENCE_S
from iris_session.rrd.paths import resume_path, split_part, split_resume
from iris_session.security.resume_tokens import encode_handback
from iris_session.session.config import SessionConfig, check_arguments, check_objects, check_robots
from iris_session.session.core import SessionCore
from iris_session.session.errors import ConfigError, ResumeError
from iris_session.session.robots import RobotChoice, choose_robots, list_notices_again
from iris_session.session.verification import NEWER_CONTROL, ReplayCore
from iris_session.system.files import Replacement

NOTE_FILE: Final = "resume.tokens"
#: Changes of the note within this time are written together.
NOTE_PERIOD_S: Final = 0.05
MAX_NOTE_BYTES: Final = 4_000_000
#: After a reboot the clock does not show the length of the gap. Session time then continues this far above the last
#: row, beyond all rows that clients may have seen and that did not reach the disk.
MARGIN_NS: Final = 10_000_000_000
PORTS_S: Final = 3.0
#: Keyframes that are tried.
MAX_KEYFRAMES: Final = 8


_log = logging.getLogger(__name__)


class Scene(NamedTuple):
    """A model, its robots and its objects. `notices`: what is unclear about robots, a line each."""

    model: mujoco.MjModel
    robots: tuple[RobotSpec, ...]
    objects: tuple[ObjectSpec, ...]
    notices: tuple[str, ...] = ()


class PastSession:
    """A session restored from its recording.

    Args:
        path: Any file of the recording, or its folder.
        patience_s: Time for the recorder of a session that was killed to finish its file [s].

    Attributes:
        core: In the state after `step`, at session time `now_ns`.
        recording: The file to continue in.
        origin_ns: `time.monotonic_ns()` at session time 0.
        is_gap_known: The host was not rebooted, so that session time went on.
        notes: Messages for people, one line each.
        anchors: New poses of anchors, when `merge_config` was given other ones.

    Raises:
        ResumeError: The session cannot be resumed; one line says why, and what would be right.
    """

    def __init__(self, path: Path, patience_s: float = PATIENCE_S) -> None:
        self.notes: list[str] = []
        self.anchors: dict[str, Pose] = {}
        first = find_first_file(path)
        try:
            self._lock, newest = _lock_newest(first, patience_s)
        except RecordingError as error:
            raise ResumeError(str(error)) from error
        self.recording = Path(resume_path(str(first), newest + 1))
        try:
            self._open_newest(first)
            self._restore_clock_and_note(first)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the lock on the recording. May be called twice."""
        self._lock.release()

    @property
    def continues(self) -> Continues:
        """Reference to the recording that is continued, for the header of the new one."""
        return Continues(self.file, self.step, self.chain)

    def merge_config(
        self,
        given: SessionConfig,
        model: mujoco.MjModel | None,
        data: mujoco.MjData | None,
        robots: object,
        objects: object,
    ) -> tuple[SessionConfig, Scene]:
        """Return configuration, model, robots and objects of the session. What is given beside `resume` must fit.

        Raises:
            ResumeError: Another model.
            ConfigError: Another value of anything that must stay as it was.
        """
        if data is not None or robots is not None or objects is not None:
            raise ConfigError("a resumed session has its state, robots and objects from the recording: leave them")
        if model is not None:
            self._check_model(model)
        core = self.core
        model, robots = core.world.model, core.scene.robots
        notices = list_notices_again(model, robots, core.config.control)
        return self._merge_settings(given), Scene(model, robots, core.scene.objects, notices)

    def _merge_settings(self, given: SessionConfig) -> SessionConfig:
        plain, core = SessionConfig(), self.core.config
        authority = msgspec.structs.replace(core.authority, anchors={})  # as it is given: anchors come beside it
        if given.record is not True:
            raise ConfigError(f"a resumed session goes on in the folder of {self.file}: leave `record` as it is")
        if given.name not in (plain.name, self.header.session_name):
            raise ConfigError(f"a resumed session keeps its name, {self.header.session_name!r}")
        # What a recording made before does not name is off there, and on in the default of a script that is the same.
        default = {name: getattr(plain.control, name) for name in NEWER_CONTROL}
        same = {name: value for name, value in default.items() if getattr(given.control, name) == value}
        control = msgspec.structs.replace(core.control, **same)
        for name, had in (("authority", authority), ("control", control)):
            if getattr(given, name) not in (getattr(plain, name), had):
                raise ConfigError(f"a resumed session keeps its settings: leave `{name}` as it is")
        changes: dict[str, Any] = {"name": self.header.session_name, "authority": authority}
        if given.anchors == plain.anchors:  # where they were last, which may be another place than at the beginning
            poses = self.core.authority.anchors or self.header.anchors
            changes["anchors"] = {name: (T.p, T.q) for name, T in poses.items()} or plain.anchors
        else:
            self.anchors = given.anchor_poses()
        for kept in (self.header.settings, None if self.note is None else self.note.listening):
            had_them = {} if kept is None else msgspec.structs.asdict(kept)
            changes |= {name: had for name, had in had_them.items() if getattr(given, name) == getattr(plain, name)}
        if "anchor_sizes" in changes:  # sheets that were given anew may be others
            anchors = changes.get("anchors", given.anchors)
            changes["anchor_sizes"] = {name: m for name, m in changes["anchor_sizes"].items() if name in anchors}
        if "anchor_marks" in changes and given.anchors != plain.anchors:
            changes["anchor_marks"] = {}
        return dataclasses.replace(given, control=core.control, **changes)

    def _check_model(self, model: mujoco.MjModel) -> None:
        here, had = compute_scene_hash(encode_model(model)), self.core.world.scene_hash
        if here != had:
            raise ResumeError(
                f"the scene is not that of {self.file}: hash {here[:12]}, recorded {had[:12]}; "
                "leave it out, the recording has it"
            )

    def _open_newest(self, first: Path) -> None:
        """Restore the newest recording from which the session can be resumed."""
        reasons: list[str] = []
        for _, path in sorted(list_recordings(first), reverse=True):
            try:
                with Recording.open(path, warn=False) as recording:
                    self.file, self.header = path.name, recording.header
                    self._restore(recording)
            except (NotARecordingError, _UnusableError) as error:
                reasons.append(f"{path.name}: {error}")
                continue
            self.notes += [f"left out {line}" for line in reasons]
            return
        raise ResumeError(f"the session cannot be resumed: {'; '.join(reasons)}")

    def _restore(self, recording: Recording) -> None:
        header = self.header
        if header.recording_class != CLOSED:
            raise ResumeError(
                f"{self.file} is of class {header.recording_class!r}: what moved it was the user's own and is not in "
                "it; only recordings of our own loop ('closed') can be resumed. Begin anew: serve the file again that "
                "was shown, or start the program that moved the world"
            )
        problems: list[str] = []
        use_one_blas_thread()  # as in the run that is replayed
        for keyframe in list_keyframes(recording):
            try:
                self.core = restore_core(header, keyframe, recording.model)
            except ResumeError:
                raise
            except Exception as error:  # a snapshot of another version may mean anything
                problems.append(f"the keyframe after step {keyframe.step} cannot be restored: {error}")
                continue
            break
        else:
            raise _UnusableError("; ".join([*problems, "it holds no state to resume from"]))
        self.step, self.chain, why = replay_rows(self.core, keyframe, recording.rows(after=keyframe.step))
        if why:  # the core may have taken the step that cannot be used
            problems.append(why)
            self.core = restore_core(header, keyframe, recording.model)
            replay_rows(
                self.core,
                keyframe,
                itertools.takewhile(lambda row: row.step <= self.step, recording.rows(after=keyframe.step)),
            )
        self.now_ns = self.core.authority.now_ns
        if recording.end is not None and recording.end.reason:
            reason = recording.end.reason[:MAX_TEXT]
            problems.append(f"{reason}: what came after {self.now_ns * 1e-9:.1f} s is not in it")
        self.notes += [f"{self.file}: {line}" for line in (*problems, *recording.damage, *recording.missing)]

    def _restore_clock_and_note(self, first: Path) -> None:
        """Read the note (where the session listened, which clients it knew), and find the origin of session time."""
        header = self.header
        self.note: ResumeNote | None
        self.note, why = read_note(first, header.session_id)
        if why:
            self.notes.append(f"{why}: participants must join again, and get their robots when the leases expire")
        last = self.core.authority.last_connection
        try:
            self.handback = encode_handback(last, b"" if self.note is None else self.note.handback)
        except msgspec.DecodeError:
            self.handback = encode_handback(last)
        now_ns = time.monotonic_ns()
        same_boot = bool(header.boot_id) and header.boot_id == read_boot_id()
        self.is_gap_known = same_boot and now_ns - header.origin_ns > self.now_ns
        self.origin_ns = header.origin_ns if self.is_gap_known else now_ns - self.now_ns - MARGIN_NS


def prepare_session(
    given: SessionConfig | None,
    model: mujoco.MjModel | str | Path | None,
    data: mujoco.MjData | None,
    robots: RobotChoice,
    objects: Sequence[ObjectSpec] | None,
) -> tuple[PastSession | None, SessionConfig, Scene]:
    """Return what a session begins with: the checked arguments of `Session`, or with `resume` the past session."""
    config = SessionConfig() if given is None else given
    model = load_model(model) if isinstance(model, str | Path) else model
    if not isinstance(config, SessionConfig) or config.resume is None:
        check_arguments(model, data, config)
        assert isinstance(model, mujoco.MjModel)
        found, things = choose_robots(model, check_robots(robots), config.control), check_objects(objects)
        return None, config, Scene(model, found.robots, find_objects(model) if things is None else things, found.texts)
    past = PastSession(Path(config.resume))
    try:
        return past, *past.merge_config(config, model, data, robots, objects)
    except BaseException:
        past.close()
        raise


def wait_for_free_ports(config: SessionConfig) -> None:
    """Wait for the front of a killed session to free its ports; if they stay in use, our front reports it."""
    until = time.monotonic() + PORTS_S
    while time.monotonic() < until and not has_free_ports(config):
        time.sleep(0.05)


def has_free_ports(config: SessionConfig) -> bool:
    """Return whether the ports of a session can be listened on."""
    ports = (config.control_port - 1, config.control_port, config.state_port)
    return all(is_port_free(config.host, port) for port in ports if port > 0)


def is_port_free(host: str, port: int) -> bool:
    """Return whether a TCP port can be listened on."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as test:
        test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            test.bind((host, port))
        except OSError as error:
            return error.errno != errno.EADDRINUSE
        return True


class _UnusableError(Exception):
    """The session cannot be resumed from this file, but perhaps from an earlier one."""


def find_first_file(path: Path) -> Path:
    """Return the first file of the session that `path` belongs to: any file of it, or its folder."""
    if path.is_dir():
        try:
            path = find_session_in(path)
        except NotARecordingError as error:
            raise ResumeError(str(error)) from error
    first = Path(split_resume(split_part(str(path))[0])[0])
    if not any(True for _ in list_recordings(first)):
        raise ResumeError(f"there is no recording {path}: give a session.rrd, or the folder it is in")
    return first


def _lock_newest(first: Path, patience_s: float) -> tuple[RecordingLock, int]:
    """Lock the newest recording of a session exclusively; return the lock and the number of the recording.

    Another process may have continued the session meanwhile; then the newer recording is tried.
    """
    while True:
        newest = max(number for number, _ in list_recordings(first))
        lock = RecordingLock(resume_path(str(first), newest), shared=False, patience_s=patience_s)
        if newest == max(number for number, _ in list_recordings(first)):
            return lock, newest
        lock.release()


def list_recordings(first: Path) -> Iterator[tuple[int, Path]]:
    """Yield number and first file of every recording of a session, in no order."""
    folder = first.parent
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    for name in names:
        stem, number = split_resume(name)
        if stem == first.name:
            yield number, folder / name


def restore_core(header: SessionHeader, keyframe: Keyframe, models: Models) -> SessionCore:
    """Return the core in the state of `keyframe`. A damaged snapshot may raise any exception.

    Raises `ResumeError` for a header from which no session can be built.
    """
    try:
        replay = ReplayCore(header, models)
    except (msgspec.DecodeError, zlib.error, PhysicsError, ControlError, ValueError) as error:
        raise ResumeError(f"the session cannot be built from the header of its recording: {error}") from error
    if keyframe.plant:
        replay.restore(keyframe)
    return replay.core


def list_keyframes(recording: Recording) -> Iterator[Keyframe]:
    """Yield states to resume from, best first: intact keyframes, newest first; the initial state has an empty plant."""
    intact = (keyframe for keyframe in recording.keyframes() if not check_keyframe(keyframe))
    yield from reversed(deque(intact, maxlen=MAX_KEYFRAMES))
    if recording.header.continues is None:
        yield Keyframe(-1, b"", b"", b"", b"", recording.root)


def replay_rows(core: SessionCore, keyframe: Keyframe, rows: Iterator[JournalRow]) -> tuple[int, bytes, str]:
    """Replay the rows after `keyframe` as long as they are intact and give the recorded digest.

    Returns:
        The newest step that did, its chain value, and why it is not the last one, empty when it is. In that case `core`
        may have taken the next step, too.
    """
    step, chain = keyframe.step, keyframe.chain
    for row in rows:
        if row.step != step + 1:
            return step, chain, f"steps {step + 1} to {row.step - 1} are missing, and what follows"
        problem = check_row(chain, row)
        if problem is not None:
            return step, chain, f"step {row.step} was changed ({problem.field}): left out from there"
        if row.digest == CRASHED:
            return step, chain, f"step {row.step} ended the session with an error: left out"
        try:
            outcome = core.step(row.now_ns, decode_entries(row.entries), row.n_ticks)
        except Exception as error:
            return step, chain, f"step {row.step} cannot be taken again ({error}): left out from there"
        if not is_result(row, outcome.digest):
            return step, chain, f"step {row.step} gives another result here: left out from there"
        step, chain = row.step, row.chain
    return step, chain, ""


class Listening(msgspec.Struct, frozen=True):
    """Addresses on which a session listened, as in `SessionConfig`, with the ports that were used in the end."""

    host: str = ""
    interfaces: tuple[str, ...] = ()
    advertise: str = ""
    beacon_port: int = DISCOVERY_PORT
    control_port: int = 0
    state_port: int = 0
    curve: bool = False
    curve_key: str = ""
    curve_clients: str = ""


class ResumeNote(msgspec.Struct, frozen=True):
    """The content of `resume.tokens`. `handback`: opaque state of the newest front."""

    session_id: str
    listening: Listening = Listening()
    handback: bytes = b""


def find_note_path(recording: Path) -> Path:
    """Return the path of the note of a session, given its recording or a later one."""
    first, _ = split_resume(split_part(str(recording))[0])
    stem = Path(first).stem
    return Path(first).with_name(NOTE_FILE if stem == "session" else f"{stem}.{NOTE_FILE}")


def read_note(recording: Path, session_id: str) -> tuple[ResumeNote | None, str]:
    """Return the note of session `session_id`, or `None` and why there is none that can be used."""
    path = find_note_path(recording)
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(MAX_NOTE_BYTES)
    except FileNotFoundError:
        return None, f"there is no {path.name}"
    except OSError as error:
        return None, f"{path.name} cannot be read: {error.strerror}"
    if stat.S_IMODE(status.st_mode) & 0o077 or status.st_uid != os.geteuid():
        return None, f"{path.name} is not ours alone, so it is not trusted: chmod 600 {path}"
    try:
        note = msgspec.msgpack.decode(data, type=ResumeNote)
    except msgspec.DecodeError as error:
        return None, f"{path.name} is damaged: {error}"
    if note.session_id != session_id:
        return None, f"{path.name} is of another session"
    return note, ""


class ResumeNoteWriter:
    """Writer of the note of one session, with its own thread. `offer` never waits.

    Nothing is written after `close` returns: by then the note may be that of the next session.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._note: ResumeNote | None = None
        self._changed = threading.Event()
        self._closing = threading.Event()
        self._is_closed = self._has_warned = False
        self._replacing = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="iris-session-note", daemon=True)
        self._thread.start()

    def offer(self, note: ResumeNote) -> None:
        """Set the note that is to be written soon."""
        if note != self._note:
            self._note = note
            self._changed.set()

    def close(self, patience_s: float = 0.5) -> None:
        """Write the last note, waiting for the disk at most `patience_s` seconds."""
        self._closing.set()
        self._changed.set()
        self._thread.join(patience_s)
        free = self._replacing.acquire(timeout=patience_s)  # a disk that hangs must not delay the end
        self._is_closed = True
        if free:
            self._replacing.release()

    def _run(self) -> None:
        written: ResumeNote | None = None
        is_last = False
        while not is_last:
            self._changed.wait()
            self._closing.wait(NOTE_PERIOD_S)
            self._changed.clear()
            is_last = self._closing.is_set()  # before the note is read: no other one is offered afterwards
            note = self._note
            if note is not None and note is not written:
                self._write(note)
                written = note

    def _write(self, note: ResumeNote) -> None:
        try:
            with Replacement(self._path, durable=True) as replacement:
                replacement.file.write(msgspec.msgpack.encode(note))
                replacement.finish()  # before the lock is taken: it may wait for a disk
                with self._replacing:
                    if self._is_closed:
                        replacement.discard()
                    else:
                        replacement.commit()
        except OSError as error:
            if not self._has_warned:
                text = "%s cannot be written (%s): clients cannot resume after a restart of the session"
                _log.warning(text, self._path, error.strerror)
            self._has_warned = True
