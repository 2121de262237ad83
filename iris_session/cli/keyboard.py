"""Keys of the terminal that runs `serve`: e-stop, clear, pause, episodes. Nothing is read without a terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, NamedTuple

from iris_session.protocol.names import EpisodeAction, EpisodeState

if TYPE_CHECKING:
    from iris_session.session.session_base import SessionBase

#: Time until a terminal is looked at again while another program has it [s].
BACKGROUND_S: Final = 0.5
ESTOP_KEY: Final = " "


class KeyBinding(NamedTuple):
    """A key: its name in the footer, and what it does."""

    text: str
    act: Callable[[], None]


def bind_session_keys(session: SessionBase) -> dict[str, KeyBinding]:
    """Return the keys of a session: space for the e-stop, `c` to clear it, `p` to pause and resume where it can, and
    those of episodes.
    """
    from iris_session.session.session import Session

    keys = {
        ESTOP_KEY: KeyBinding("space e-stop", lambda: session.estop("key in the terminal of the session")),
        "c": KeyBinding("c clear e-stop", session.clear_estop),
    }
    if isinstance(session, Session):

        def toggle_pause() -> None:
            session.resume() if session.status().paused else session.pause()

        def begin_or_succeed() -> None:
            now = session.episode
            is_over = now is None or now.state in EpisodeState.OVER
            session.start_episode() if is_over else session.end_episode()

        keys["p"] = KeyBinding("p pause/resume", toggle_pause)
        keys["e"] = KeyBinding("e start/success", begin_or_succeed)
        keys["f"] = KeyBinding("f failure", lambda: session.end_episode(EpisodeAction.FAILURE))
        keys["d"] = KeyBinding("d discard", session.discard_episode)
        keys["t"] = KeyBinding("t take over", session.take_over_episode)
    return keys


@contextmanager
def read_keys(keys: Mapping[str, KeyBinding]) -> Iterator[bool]:
    """Act on keys until the context ends, in a thread of its own: a key must not wait for the loop of the session.

    Yields False when standard input is no terminal, or not ours: a command in the background leaves it alone.
    """
    fd = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else -1
    if fd < 0 or not _owns_terminal(fd):
        yield False
        return
    before = termios.tcgetattr(fd)
    wake_read, wake_write = os.pipe()
    thread = threading.Thread(target=_follow_keys, args=(fd, wake_read, keys), name="iris-keys", daemon=True)
    tty.setcbreak(fd)  # keys without Enter; Ctrl-C stays a signal
    thread.start()
    try:
        yield True
    finally:
        os.close(wake_write)
        thread.join()
        os.close(wake_read)
        if _owns_terminal(fd):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _owns_terminal(fd: int) -> bool:
    """Return whether this process is in the foreground of its terminal; reading it elsewhere would stop the process."""
    with suppress(OSError):
        return os.tcgetpgrp(fd) == os.getpgrp()
    return False


def _follow_keys(fd: int, wake: int, keys: Mapping[str, KeyBinding]) -> None:
    ready = select.poll()
    ready.register(wake)
    while True:
        ready.register(fd, select.POLLIN)
        found = [one for one, _ in ready.poll(int(BACKGROUND_S * 1e3))]
        if wake in found:
            return
        if not _owns_terminal(fd):  # sent to the background (Ctrl-Z, bg)
            ready.unregister(fd)
            if ready.poll(int(BACKGROUND_S * 1e3)):
                return
            continue
        with suppress(termios.error):
            local_modes = termios.tcgetattr(fd)[3]
            if local_modes & termios.ICANON:  # a shell has had the terminal meanwhile
                tty.setcbreak(fd)
        if fd not in found:
            continue
        with suppress(OSError):
            typed = os.read(fd, 64)
            if not typed:
                return  # the terminal is closed
            _act(typed.decode("ascii", "replace"), keys)


def _act(typed: str, keys: Mapping[str, KeyBinding]) -> None:
    """Run the binding of a typed key. Of several at once (a paste, a key held down) only the e-stop counts, and an
    escape sequence (an arrow) is none.
    """
    from iris_session.session.errors import SessionError

    if typed.startswith("\x1b"):
        return
    key = typed[0] if len(set(typed)) == 1 else ESTOP_KEY
    if key in typed and key in keys:
        with suppress(SessionError):  # the session is closing
            keys[key].act()
