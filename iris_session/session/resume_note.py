"""`resume.tokens` beside a recording: what of a running session is in no journal, kept for `serve --resume`.

The memory of its front (hashes of resume tokens, connection numbers) and where it listened. Readable by its owner
only. Written by a thread of its own whenever it changes, as a whole and durably: a disk that hangs delays no step.
"""

from __future__ import annotations

import logging
import os
import stat
import threading
from pathlib import Path
from typing import Final

import msgspec

from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.recording.paths import split_part, split_resume
from iris_session.system.files import Replacement

FILE: Final = "resume.tokens"
#: Changes that come faster are written together.
PERIOD_S: Final = 0.05
MAX_BYTES: Final = 4_000_000
_log = logging.getLogger(__name__)
_decode = msgspec.msgpack.Decoder


class Listening(msgspec.Struct, frozen=True):
    """Where a session listened, as in `SessionConfig`; ports as they were in the end."""

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
    """`handback`: opaque memory of the newest front."""

    session_id: str
    listening: Listening = Listening()
    handback: bytes = b""


def note_path(recording: Path) -> Path:
    """The note of the session whose recording this is, or one of its later ones."""
    first, _ = split_resume(split_part(str(recording))[0])
    stem = Path(first).stem
    return Path(first).with_name(FILE if stem == "session" else f"{stem}.{FILE}")


def read_note(recording: Path, session_id: str) -> tuple[ResumeNote | None, str]:
    """The note of session `session_id`, and why there is none that can be used."""
    path = note_path(recording)
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(MAX_BYTES)
    except FileNotFoundError:
        return None, f"there is no {path.name}"
    except OSError as error:
        return None, f"{path.name} cannot be read: {error.strerror}"
    if stat.S_IMODE(status.st_mode) & 0o077 or status.st_uid != os.geteuid():
        return None, f"{path.name} is not ours alone, so it is not trusted: chmod 600 {path}"
    try:
        note = _decode(ResumeNote).decode(data)
    except msgspec.DecodeError as error:
        return None, f"{path.name} is damaged: {error}"
    if note.session_id != session_id:
        return None, f"{path.name} is of another session"
    return note, ""


class NoteKeeper:
    """Keeps the note of one session. `offer` never waits; `close` writes what is left, for at most `patience_s`.

    What is not written by then is not written at all: the note may be that of the next session by the time.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._note: ResumeNote | None = None
        self._changed = threading.Event()
        self._closed = threading.Event()
        self._given_up = False
        self._replacing = threading.Lock()
        self._warned = False
        self._thread = threading.Thread(target=self._run, name="iris-session-note", daemon=True)
        self._thread.start()

    def offer(self, note: ResumeNote) -> None:
        """Another note, to be written soon."""
        if note != self._note:
            self._note = note
            self._changed.set()

    def close(self, patience_s: float = 0.5) -> None:
        self._closed.set()
        self._changed.set()
        self._thread.join(patience_s)
        free = self._replacing.acquire(timeout=patience_s)  # a disk that hangs keeps nobody from ending
        self._given_up = True
        if free:
            self._replacing.release()

    def _run(self) -> None:
        written: ResumeNote | None = None
        while True:
            self._changed.wait()
            self._closed.wait(PERIOD_S)
            self._changed.clear()
            last = self._closed.is_set()  # before the note is read: nobody offers another one afterwards
            note = self._note
            if note is not None and note is not written:
                self._write(note)
                written = note
            if last:
                return

    def _write(self, note: ResumeNote) -> None:
        try:
            with Replacement(self._path, durable=True) as replacement:
                replacement.file.write(msgspec.msgpack.encode(note))
                replacement.finish()  # before the lock is taken: it may wait for a disk
                with self._replacing:
                    if self._given_up:
                        replacement.discard()
                    else:
                        replacement.commit()
        except OSError as error:
            if not self._warned:
                _log.warning("%s cannot be written (%s): nobody resumes after a restart", self._path, error.strerror)
            self._warned = True
