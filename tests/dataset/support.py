"""Small recordings with episodes, and what their sessions had at every tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec

from iris_session.journal.messages import StateFrame
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.entries import Entry, Join
from iris_session.recording import CLOSED
from iris_session.session.core import SessionCore
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
) -> Played:
    """Play a session with episodes, and write its recording."""
    path.parent.mkdir(parents=True, exist_ok=True)
    core = core or make_drawn_core(user_owned_loop=recording_class != CLOSED)
    made = play(path, steps, make_entries=make_entries(episodes), core=core, recording_class=recording_class)
    made.batch.states = make_states(made)
    made.write()
    return made


def read_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def make_states(played: Played) -> list[StateFrame]:
    """Return the states of a session as it records them, one in `STATE_STEPS` steps."""
    ids = [body.id for body in played.header.bodies]
    return [
        StateFrame(step, step, step * TICK_NS * 1e-9, played.session_time[step], played.bodies[step][ids].tobytes())
        for step in range(0, len(played.bodies), STATE_STEPS)
    ]
