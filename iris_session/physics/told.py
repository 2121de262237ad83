"""What MuJoCo warns of, caught: by itself it prints a line and writes MUJOCO_LOG.TXT into the current folder."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

import mujoco

from iris_session.physics.errors import one_line

#: The handler is one of the whole process.
_alone = threading.Lock()


@contextlib.contextmanager
def caught_warnings() -> Iterator[list[str]]:
    """Warnings of this thread while it is inside, a line each. Those of others go where they went, or to stderr."""
    caught: list[str] = []
    ours = threading.get_ident()
    with _alone:
        before = mujoco.get_mju_user_warning()

        def handle(text: str) -> None:
            if threading.get_ident() == ours:
                caught.append(one_line(text))
            elif before is not None:
                before(text)
            else:
                print(f"WARNING: {one_line(text)}", file=sys.stderr)

        mujoco.set_mju_user_warning(handle)
        try:
            yield caught
        finally:
            mujoco.set_mju_user_warning(before)
