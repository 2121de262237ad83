"""Going on from a recording: the newest file of a session, its last keyframe, and the rows after it taken again.

The state is exactly that after the last row that can be taken again with the same result. What comes after it (a file
cut short, a step that crashed, rows that other versions of the libraries compute otherwise) is left out, and said.
"""

from __future__ import annotations

import dataclasses
import errno
import socket
import time
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco

from iris_session.control import ControlError
from iris_session.physics import (
    PhysicsError,
    find_objects,
    find_robots,
    load_model,
    model_bytes,
    model_from_bytes,
    scene_hash,
)
from iris_session.protocol.common import Pose
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
    unpack_model,
)
from iris_session.recording.environment import read_boot_id, use_one_blas_thread
from iris_session.recording.journal import CRASHED, check_keyframe
from iris_session.recording.lock import PATIENCE_S
from iris_session.recording.paths import resume_path, split_part, split_resume
from iris_session.recording.verify import Models
from iris_session.security.resume_tokens import encode_handback
from iris_session.session.config import SessionConfig
from iris_session.session.config_checks import check_arguments, check_objects, check_robots
from iris_session.session.core import CoreConfig, CoreState, SessionCore
from iris_session.session.errors import ConfigError, ResumeError
from iris_session.session.resume_note import ResumeNote, read_note

#: On another boot the clock says nothing about the gap: session time goes on above everything that rows which did not
#: reach the disk may have told the clients.
MARGIN_NS: Final = 10_000_000_000
PORTS_S: Final = 3.0
#: Keyframes that are tried.
STARTS: Final = 8


#: A model, its robots and its objects.
Scene = tuple[mujoco.MjModel, tuple[RobotSpec, ...], tuple[ObjectSpec, ...]]


class Continuation:
    """A session as it was. Raises `ResumeError`, with one line that says what would be right.

    `path`: any file of the recording, or the folder that `session.rrd` is in. `core`: in the state after `step`, at
    session time `now_ns`. `recording`: the file to go on in. `origin_ns`: of session time, as `time.monotonic_ns()`.
    `notes`: what people should know. `anchors`: where they are, when `take` was given that anew. `patience_s`: for the
    recorder of a session that was killed to finish its file.
    """

    def __init__(self, path: Path, patience_s: float = PATIENCE_S) -> None:
        self.notes: list[str] = []
        self.anchors: dict[str, Pose] = {}
        first = first_file(path)
        try:
            self._lock, newest = _lock_newest(first, patience_s)
        except RecordingError as error:
            raise ResumeError(str(error)) from error
        self.recording = Path(resume_path(str(first), newest + 1))
        try:
            self._open(first)
            self._listen(first)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Lets others continue it. May be called twice."""
        self._lock.release()

    @property
    def continues(self) -> Continues:
        """For the header of the new recording."""
        return Continues(self.file, self.step, self.chain)

    def take(
        self,
        given: SessionConfig,
        model: mujoco.MjModel | None,
        data: mujoco.MjData | None,
        robots: object,
        objects: object,
    ) -> tuple[SessionConfig, Scene]:
        """Configuration, model, robots and objects of the session. What is given beside `resume` must fit.

        Raises `ResumeError` for another model, `ConfigError` for anything else that cannot be another than it was.
        """
        if data is not None or robots is not None or objects is not None:
            raise ConfigError("a resumed session has its state, robots and objects from the recording: leave them")
        if model is not None:
            self._check(model)
        core = self.core
        return self._config(given), (core.world.model, core.scene.robots, core.scene.objects)

    def _config(self, given: SessionConfig) -> SessionConfig:
        plain, core = SessionConfig(), self.core.config
        authority = msgspec.structs.replace(core.authority, anchors={})  # as it is given: anchors come beside it
        if given.record is not True:
            raise ConfigError(f"a resumed session goes on in the folder of {self.file}: leave `record` as it is")
        if given.name not in (plain.name, self.header.session_name):
            raise ConfigError(f"a resumed session keeps its name, {self.header.session_name!r}")
        for name, had in (("authority", authority), ("control", core.control)):
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
        return dataclasses.replace(given, control=core.control, **changes)

    def _check(self, model: mujoco.MjModel) -> None:
        here, had = scene_hash(model_bytes(model)), self.core.world.scene_hash
        if here != had:
            raise ResumeError(
                f"the scene is not that of {self.file}: hash {here[:12]}, recorded {had[:12]}; "
                "leave it out, the recording has it"
            )

    def _open(self, first: Path) -> None:
        """The newest recording from which the session can go on."""
        reasons: list[str] = []
        for _, path in sorted(recordings(first), reverse=True):
            try:
                with Recording.open(path, warn=False) as recording:
                    self.file, self.header = path.name, recording.header
                    self._restore(recording)
            except (NotARecordingError, _UnusableError) as error:
                reasons.append(f"{path.name}: {error}")
                continue
            self.notes += [f"left out {line}" for line in reasons]
            return
        raise ResumeError(f"the session cannot go on: {'; '.join(reasons)}")

    def _restore(self, recording: Recording) -> None:
        header = self.header
        if header.recording_class != CLOSED:
            raise ResumeError(
                f"{self.file} is of class {header.recording_class!r}: what moved it was the user's own and is not in "
                "it; only recordings of our own loop ('closed') can be resumed. Begin anew: serve the file again that "
                "was shown, or start the program that moved the world"
            )
        problems: list[str] = []
        use_one_blas_thread()  # as in the run that is taken again
        for keyframe in starts(recording):
            try:
                self.core = core_at(header, keyframe, recording.model)
            except ResumeError:
                raise
            except Exception as error:  # a snapshot of another version may mean anything
                problems.append(f"the keyframe after step {keyframe.step} cannot be restored: {error}")
                continue
            break
        else:
            raise _UnusableError("; ".join([*problems, "it holds no state to go on from"]))
        self.step, self.chain, stopped = run(self.core, keyframe, recording.rows(after=keyframe.step))
        if stopped.taken:
            self.core = core_at(header, keyframe, recording.model)
            rows = recording.rows(after=keyframe.step)
            self.step, self.chain, _ = run(self.core, keyframe, (row for row in rows if row.step < stopped.step))
        if stopped.text:
            problems.append(stopped.text)
        self.now_ns = self.core.authority.now_ns
        self.notes += [f"{self.file}: {line}" for line in (*problems, *recording.damage, *recording.missing)]

    def _listen(self, first: Path) -> None:
        """Where the session listened, whom it knew, and what time it is."""
        header = self.header
        self.note: ResumeNote | None
        self.note, why = read_note(first, header.session_id)
        if why:
            self.notes.append(f"{why}: who was in the session joins anew, and gets robots when their leases expire")
        last = self.core.authority.last_connection
        try:
            self.handback = encode_handback(last, b"" if self.note is None else self.note.handback)
        except msgspec.DecodeError:
            self.handback = encode_handback(last)
        now_ns = time.monotonic_ns()
        same_boot = bool(header.boot_id) and header.boot_id == read_boot_id()
        origin_ns = header.origin_ns if same_boot else now_ns
        if now_ns - origin_ns <= self.now_ns:
            origin_ns = now_ns - self.now_ns - MARGIN_NS
        self.origin_ns = origin_ns


def begin(
    given: SessionConfig | None,
    model: mujoco.MjModel | str | Path | None,
    data: mujoco.MjData | None,
    robots: Sequence[RobotSpec] | None,
    objects: Sequence[ObjectSpec] | None,
) -> tuple[Continuation | None, SessionConfig, Scene]:
    """What a session begins with: the arguments of `Session`, or with `resume` the session as it was."""
    config = SessionConfig() if given is None else given
    model = load_model(model) if isinstance(model, str | Path) else model
    if not isinstance(config, SessionConfig) or config.resume is None:
        check_arguments(model, data, config)
        assert isinstance(model, mujoco.MjModel)
        named, things = check_robots(robots), check_objects(objects)
        found = tuple(find_robots(model)) if named is None else named
        return None, config, (model, found, tuple(find_objects(model)) if things is None else things)
    past = Continuation(Path(config.resume))
    try:
        return past, *past.take(config, model, data, robots, objects)
    except BaseException:
        past.close()
        raise


def wait_until_free(config: SessionConfig, patience_s: float = PORTS_S) -> None:
    """Waits for the front of a session that was killed to leave its ports; who has them longer is told by ours."""
    ports = [port for port in (config.control_port - 1, config.control_port, config.state_port) if port > 0]
    until = time.monotonic() + patience_s
    while time.monotonic() < until and not all(_free(config.host, port) for port in ports):
        time.sleep(0.05)


def _free(host: str, port: int) -> bool:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as test:
        test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            test.bind((host, port))
        except OSError as error:
            return error.errno != errno.EADDRINUSE
        return True


class _UnusableError(Exception):
    """This file holds nothing to go on from; an earlier one may."""


class Stopped(msgspec.Struct, frozen=True):
    """Why the rows after a keyframe were not taken to their end: empty when they were. `taken`: the core took `step`
    all the same, with another result."""

    step: int = -1
    text: str = ""
    taken: bool = False


def first_file(path: Path) -> Path:
    """File of the beginning of the session that `path` is of: any file of it, or the folder of `session.rrd`."""
    if path.is_dir():
        path = path / "session.rrd"
    first = Path(split_resume(split_part(str(path))[0])[0])
    if not any(True for _ in recordings(first)):
        raise ResumeError(f"there is no recording {path}: give a session.rrd, or the folder it is in")
    return first


def _lock_newest(first: Path, patience_s: float) -> tuple[RecordingLock, int]:
    """The newest recording of a session and its number, for us alone; while we waited, somebody may have gone on."""
    while True:
        newest = max(number for number, _ in recordings(first))
        lock = RecordingLock(resume_path(str(first), newest), shared=False, patience_s=patience_s)
        if newest == max(number for number, _ in recordings(first)):
            return lock, newest
        lock.release()


def recordings(first: Path) -> Iterator[tuple[int, Path]]:
    """Number and first file of every recording of a session, in no order."""
    folder = first.parent
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    for name in names:
        stem, number = split_resume(name)
        if stem == first.name:
            yield number, folder / name


def make_core(header: SessionHeader, models: Models) -> SessionCore:
    """The session as its header describes it, in its initial state. Raises `ResumeError`."""
    try:
        config = msgspec.msgpack.decode(header.config, type=CoreConfig)
        model = model_from_bytes(unpack_model(header.model))
        return SessionCore(model, config, lambda model_hash: model_from_bytes(models(model_hash)))
    except (msgspec.DecodeError, zlib.error, PhysicsError, ControlError, ValueError) as error:
        raise ResumeError(f"the session cannot be built from the header of its recording: {error}") from error


def core_at(header: SessionHeader, keyframe: Keyframe, models: Models) -> SessionCore:
    """The session in the state of `keyframe`. Raises whatever damaged snapshots lead to."""
    core = make_core(header, models)
    if keyframe.plant:
        core.restore(CoreState(keyframe.plant, keyframe.authority, keyframe.controller, keyframe.status))
    return core


def starts(recording: Recording) -> Iterator[Keyframe]:
    """States to go on from, best first: intact keyframes, newest first; the initial state has an empty plant."""
    intact = (keyframe for keyframe in recording.keyframes() if not check_keyframe(keyframe))
    yield from reversed(deque(intact, maxlen=STARTS))
    if recording.header.continues is None:
        yield Keyframe(-1, b"", b"", b"", b"", recording.root)


def run(core: SessionCore, keyframe: Keyframe, rows: Iterator[JournalRow]) -> tuple[int, bytes, Stopped]:
    """Takes the steps after `keyframe` again, as long as they are intact and give what they gave.

    Gives the newest step in whose state `core` is, its chain value, and why it is not the last one.
    """
    step, chain = keyframe.step, keyframe.chain
    for row in rows:
        if row.step != step + 1:
            return step, chain, Stopped(row.step, f"steps {step + 1} to {row.step - 1} are missing, and what follows")
        problem = check_row(chain, row)
        if problem is not None:
            return step, chain, Stopped(row.step, f"step {row.step} was changed ({problem.field}): left out from there")
        if row.digest == CRASHED:
            return step, chain, Stopped(row.step, f"step {row.step} ended the session with an error: left out")
        try:
            outcome = core.step(row.now_ns, decode_entries(row.entries), row.n_ticks)
        except Exception as error:
            text = f"step {row.step} cannot be taken again ({error}): left out from there"
            return step, chain, Stopped(row.step, text, taken=True)
        if outcome.digest != row.digest:
            text = f"step {row.step} gives another result here: left out from there"
            return step, chain, Stopped(row.step, text, taken=True)
        step, chain = row.step, row.chain
    return step, chain, Stopped()
