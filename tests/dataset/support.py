"""Small recordings with episodes, and what their sessions had at every tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from iris_session.cameras.drawing import encode_jpeg
from iris_session.journal.messages import StateFrame
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.media import StreamInfo
from iris_session.recording import CLOSED
from iris_session.session.core import SessionCore
from tests.recording.test_media import message
from tests.replay.support import Played, make_drawn_core, play
from tests.session.play import ANN, TICK_NS, entries

#: A name that is in no file by chance.
NAME = "Zebulon"
#: Two successes and a failure, by steps; robots move from step 50 on.
EPISODES: dict[int, str] = {20: "start", 90: "success", 100: "start", 150: "failure", 160: "start", 190: "success"}
STEPS = 200
STATE_STEPS = 5


def make_entries(episodes: Mapping[int, str] = EPISODES, name: str = NAME) -> Callable[[int], Sequence[Entry]]:
    """Return the entries of a session in which a person moves the left robot and runs episodes."""

    def make(step: int) -> list[Entry]:
        found = entries(step)
        if step == 0:
            assert isinstance(found[0].message, Join)
            found = [msgspec.structs.replace(found[0], message=msgspec.structs.replace(found[0].message, name=name))]
        if step in episodes:
            label = f"{name} lifts it" if episodes[step] == "start" else ""
            message = Episode(100 + step, episodes[step], label, countdown_ns=0)
            found.append(Entry(ANN, ANN, (step + 1) * TICK_NS, message))
        return found

    return make


def record(
    path: Path,
    episodes: Mapping[int, str] = EPISODES,
    *,
    steps: int = STEPS,
    core: SessionCore | None = None,
    recording_class: str = CLOSED,
    captures: Sequence[tuple[int, int]] = (),
) -> Played:
    """Play a session with episodes, and write its recording.

    `captures`: of pictures of a real camera, `room-front`: at a step, and so much later [ns]. The i-th has the grey
    `make_grey(i)`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    core = core or make_drawn_core(user_owned_loop=recording_class != CLOSED)
    made = play(path, steps, make_entries=make_entries(episodes), core=core, recording_class=recording_class)
    made.batch.states = make_states(made)
    for i, (step, later_ns) in enumerate(captures):
        jpeg = encode_jpeg(np.full((32, 48, 3), make_grey(i), np.uint8))
        made.media.append(message("room-front", jpeg, i, made.session_time[step] + later_ns, "jpeg", StreamInfo()))
    made.write()
    return made


def make_grey(i: int) -> int:
    return 20 + 20 * i


def read_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def make_states(played: Played) -> list[StateFrame]:
    """Return the states of a session as it records them, one in `STATE_STEPS` steps."""
    ids = [body.id for body in played.header.bodies]
    return [
        StateFrame(step, step, step * TICK_NS * 1e-9, played.session_time[step], played.bodies[step][ids].tobytes())
        for step in range(0, len(played.bodies), STATE_STEPS)
    ]
