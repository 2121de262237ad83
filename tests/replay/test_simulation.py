"""Replay: every step as the session had it, gaps left out to the next keyframe, other results refused."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from iris_session.journal.rows import CRASHED
from iris_session.recording import OPEN, Continues, Recording, make_row
from iris_session.replay.simulation import Replay, ReplayError
from iris_session.session.core import SessionCore
from tests.replay.support import Played, damaged, play
from tests.session.play import TICK_NS


def replay(path: Path, *, with_control: bool = True) -> tuple[list[int], list[bytes], Replay]:
    """Return steps and positions after each."""
    with Recording.open(path, warn=False) as recording:
        taken = Replay(recording, with_control=with_control)
        rows = [(step.step, taken.core.world.data.qpos.tobytes()) for step in taken.steps()]
    return [step for step, _ in rows], [qpos for _, qpos in rows], taken


def assert_equals(played: Played, steps: list[int], positions: list[bytes]) -> None:
    assert positions == [played.qpos[step].tobytes() for step in steps]


def test_open_sessions_need_no_control(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = play(tmp_path / "session.rrd", 5, recording_class=OPEN).write()

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a step was taken")

    monkeypatch.setattr(SessionCore, "step", refuse)
    assert len(replay(path, with_control=False)[0]) == 5
    with pytest.raises(ReplayError, match="step 0 cannot be taken again: AssertionError: a step was taken"):
        replay(path)


@pytest.mark.parametrize("fault", ["two rows are missing", "digest", "step", "a keyframe is damaged too"])
def test_after_a_gap_it_goes_on_at_the_next_intact_keyframe(tmp_path: Path, fault: str) -> None:
    played = play(tmp_path / "session.rrd", 70)
    rows, keyframes = played.batch.rows, played.batch.keyframes
    resumes = 60 if "keyframe" in fault else 40
    if fault == "digest":
        rows[25] = damaged(rows[25])
    elif fault == "step":
        rows[25] = msgspec.structs.replace(rows[25], step=9025)
    else:
        del rows[25:27]
    if "keyframe" in fault:
        at = next(i for i, one in enumerate(keyframes) if one.step == 39)
        keyframes[at] = msgspec.structs.replace(keyframes[at], plant=b"other")
    steps, positions, taken = replay(played.write())
    assert steps == [*range(25), *range(resumes, 70)]
    assert_equals(played, steps, positions)
    assert taken.left_out == [(25, resumes - 1)]
    assert f"{resumes - 25} steps are missing" in taken.describe_left_out()


def test_another_result_is_an_error_with_its_step(tmp_path: Path) -> None:
    played = play(tmp_path / "session.rrd", 10)
    rows = played.batch.rows
    rows[5] = make_row(rows[4].chain, 5, rows[5].now_ns, 1, [], b"another result..")  # intact, but not so
    played.header = msgspec.structs.replace(played.header, versions={"mujoco": "1.2.3"})
    with pytest.raises(ReplayError, match=r"step 5 gives another result .* \(mujoco: recorded 1\.2\.3, here ") as found:
        replay(played.write())
    assert "\n" not in str(found.value)


def test_a_step_that_ended_the_session_has_no_result(tmp_path: Path) -> None:
    played = play(tmp_path / "session.rrd", 5)
    last = played.batch.rows[-1]
    played.batch.rows.append(make_row(last.chain, 5, last.now_ns + TICK_NS, 1, [], CRASHED))
    assert replay(played.write())[0] == list(range(5))


def test_a_resumed_session_begins_at_its_keyframe(tmp_path: Path) -> None:
    played = play(tmp_path / "session.resume2.rrd", 70)
    rows, keyframes = played.batch.rows, played.batch.keyframes
    continues = Continues("session.rrd", 39, rows[39].chain)
    played.header = msgspec.structs.replace(played.header, continues=continues)
    played.batch.rows, played.batch.keyframes = rows[40:], [one for one in keyframes if one.step == 39]
    steps, positions, taken = replay(played.write())
    assert steps == list(range(40, 70))
    assert_equals(played, steps, positions)
    assert not taken.left_out


def test_a_header_that_is_none_is_one_line(tmp_path: Path) -> None:
    played = play(tmp_path / "session.rrd", 5)
    played.header = msgspec.structs.replace(played.header, config=b"config")
    with pytest.raises(ReplayError, match="the session cannot be built from the header: ") as found:
        replay(played.write())
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("spans", [[(5, 9), (9, 12), (33, 36)], [(30, 31), (62, 70)], [(0, 1), (45, 47)]])
def test_spans_of_steps_are_taken_in_one_pass(tmp_path: Path, spans: list[tuple[int, int]]) -> None:
    played = play(tmp_path / "session.rrd", 70)
    with Recording.open(played.write(), warn=False) as recording:
        taken = Replay(recording)
        for first, end in spans:
            steps = {s.step: taken.core.world.data.qpos.tobytes() for s in taken.steps_between(first, end)}
            assert sorted(steps) == list(range(min(steps), end))
            assert first - min(steps) < 20
            assert_equals(played, sorted(steps), [steps[step] for step in sorted(steps)])
