"""Resuming from a recording: the exact state of its last valid row, damaged files, refused settings."""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import mujoco
import pytest

from anchors.pose import IDENTITY_QUAT, PoseTuple
from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.control.config import SOLVER_MINK, SOLVER_NUMPY
from iris_session.demo.scenes import scene_path
from iris_session.journal.environment import read_boot_id
from iris_session.journal.messages import Batch
from iris_session.journal.rows import CRASHED, seal_keyframe
from iris_session.physics import encode_model, load_model
from iris_session.protocol.client_messages import Marker, MoveAnchor
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, decode_entries
from iris_session.recording import CLOSED, OPEN, JournalRow, Keyframe, RecordingLock, Settings, header_root, make_row
from iris_session.security.resume_tokens import ResumeTokens, encode_handback
from iris_session.session.config import SessionConfig
from iris_session.session.core import CoreState, SessionCore
from iris_session.session.errors import ConfigError, ResumeError
from iris_session.session.processes import make_settings
from iris_session.session.resume import (
    MARGIN_NS,
    Listening,
    PastSession,
    ResumeNote,
    ResumeNoteWriter,
    find_note_path,
    prepare_session,
    read_note,
)
from iris_session.session.stepper import ResumedFrom, Stepper
from iris_session.session.verification import verify_recording
from tests.recording.support import write
from tests.replay.support import keyframe_of, make_header
from tests.rig.journal import Journal
from tests.session.play import ANN, TICK_NS, entries, host, make_core, play
from tests.session.test_stepper import Front

STEPS = 100
KEYFRAMES = (39, 79)
LAST_NS = STEPS * TICK_NS


def recorded(
    path: Path,
    change: Callable[[JournalRow], JournalRow] = lambda row: row,
    keyframes: Callable[[Keyframe], Keyframe] = lambda keyframe: keyframe,
    core: SessionCore | None = None,
    said: Mapping[int, list[Entry]] = MappingProxyType({}),
    **header: object,
) -> Path:
    """The scripted session of `play`, as `Session.run` records it."""
    core = core or make_core()
    usual = {
        "session_name": "lab",
        "scene_hash": core.world.scene_hash,
        "origin_ns": time.monotonic_ns() - LAST_NS,
        "boot_id": read_boot_id(),
    }
    head = msgspec.structs.replace(make_header(core, CLOSED), **{**usual, **header})
    chain = header_root(head)
    batch = Batch(keyframes=[keyframe_of(core, -1, chain)])
    for step in range(STEPS):
        now_ns = (step + 1) * TICK_NS
        came = [*entries(step), *said.get(step, ())]
        row = make_row(chain, step, now_ns, 1, came, core.step(now_ns, came, 1).digest)
        batch.rows.append(change(row))
        chain = batch.rows[-1].chain
        if step in KEYFRAMES:
            batch.keyframes.append(keyframes(keyframe_of(core, step, chain)))
    return write(path, head, batch)


def state_after(step: int) -> CoreState:
    core = make_core()
    play(core, 0, step + 1)
    return core.snapshot()


def prepare(path: Path, **config: Any) -> tuple[PastSession, SessionConfig]:
    """Prepare the session that goes on, and let go of the recording."""
    past, merged, _ = prepare_session(SessionConfig(resume=path, **config), None, None, None, None)
    assert past is not None
    past.close()
    return past, merged


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("original") / "session.rrd")


@pytest.fixture
def session(original: Path, tmp_path: Path) -> Path:
    """A copy of the recording, in a new folder."""
    return Path(shutil.copy(original, tmp_path / "session.rrd"))


def test_resumed_state_is_that_after_the_last_row(session: Path) -> None:
    past = PastSession(session.parent)
    assert (past.step, past.now_ns) == (STEPS - 1, LAST_NS)
    assert past.core.snapshot() == state_after(STEPS - 1)
    assert past.recording == session.with_name("session.resume2.rrd")
    assert past.header.session_id == "s1"
    assert len(past.notes) == 1
    assert "resume.tokens" in past.notes[0]
    assert ResumeTokens(8, past.handback).allocate_connection() == ANN + 1, "without a note: after the journal's"
    assert past.is_gap_known, "of the same boot: session time goes on"
    assert past.origin_ns == past.header.origin_ns
    past.close()


@pytest.mark.parametrize("share", [0.999, 0.8])
def test_truncated_file_resumes_at_its_last_readable_row(session: Path, share: float) -> None:
    """As after a power cut: anywhere in the middle of a write."""
    size = session.stat().st_size
    os.truncate(session, int(size * share))
    past = PastSession(session)
    assert -1 <= past.step < STEPS
    assert past.core.snapshot() == (state_after(past.step) if past.step >= 0 else make_core().snapshot())
    past.close()


@pytest.mark.parametrize(
    ("digest", "why"),
    [(None, "was changed (n_ticks)"), (bytes(16), "gives another result"), (CRASHED, "ended the session")],
)
def test_rows_from_one_that_cannot_be_used_are_left_out(tmp_path: Path, digest: bytes | None, why: str) -> None:
    """Of another result: as with another version of a library."""
    chains: list[bytes] = []

    def change(row: JournalRow) -> JournalRow:
        if row.step == 90 and digest is None:
            row = msgspec.structs.replace(row, n_ticks=2)
        elif row.step == 90:
            row = make_row(chains[-1], row.step, row.now_ns, 1, decode_entries(row.entries), digest)
        chains.append(row.chain)
        return row

    past = PastSession(recorded(tmp_path / "session.rrd", change))
    assert past.step == 89
    assert past.core.snapshot() == state_after(89)
    assert any(f"step 90 {why}" in note for note in past.notes)


def test_damaged_keyframe_is_replaced_by_the_previous_one(tmp_path: Path) -> None:
    def damage(keyframe: Keyframe) -> Keyframe:
        return msgspec.structs.replace(keyframe, plant=b"\0" * 8) if keyframe.step == KEYFRAMES[-1] else keyframe

    past = PastSession(recorded(tmp_path / "session.rrd", keyframes=damage))
    assert past.step == STEPS - 1
    assert past.core.snapshot() == state_after(STEPS - 1)


def test_newest_readable_recording_is_continued(session: Path) -> None:
    session.with_name("session.resume2.rrd").write_bytes(b"")
    session.with_name("session.resume3.rrd").write_bytes(b"no recording at all")
    past = PastSession(session)
    assert past.file == "session.rrd"
    assert past.recording.name == "session.resume4.rrd"
    assert sum("left out session.resume" in note for note in past.notes) == 2


def test_recording_in_use_is_refused(session: Path) -> None:
    writing = RecordingLock(session, shared=True)
    with pytest.raises(ResumeError, match=str(session)):
        PastSession(session, patience_s=0.1)
    writing.release()
    first = PastSession(session)
    with pytest.raises(ResumeError, match=str(session)):
        PastSession(session, patience_s=0.1)
    first.close()
    PastSession(session).close()


def test_recording_of_a_user_loop_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResumeError, match="'open'"):
        PastSession(recorded(tmp_path / "session.rrd", recording_class=OPEN))


@pytest.mark.parametrize("name", ["", "nothing.rrd", "folder"])
def test_missing_recording_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(ResumeError, match="recording") as refused:
        PastSession(tmp_path / name)
    assert "\n" not in str(refused.value)


def test_given_scene_must_equal_the_recorded_one(session: Path) -> None:
    config = SessionConfig(resume=session)
    past, _, scene = prepare_session(config, scene_path("handover"), None, None, None)
    assert past is not None
    past.close()
    assert encode_model(scene[0]) == encode_model(load_model(scene_path("handover")))
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ResumeError, match=r"session\.rrd"):
        prepare_session(config, other, None, None, None)
    PastSession(session, patience_s=0.1).close()  # a refusal keeps nothing


def test_settings_fixed_by_the_recording_are_refused(session: Path) -> None:
    past = PastSession(session)
    past.close()
    rules = AuthorityConfig(grace_ns=1)
    for name, value in (("name", "other"), ("record", False), ("record", "x.rrd"), ("authority", rules)):
        with pytest.raises(ConfigError, match="resumed session"):
            past.merge_config(SessionConfig(**{name: value}), None, None, None, None)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="robots"):
        past.merge_config(SessionConfig(), None, None, (), None)


def test_the_same_control_may_be_given_whatever_solver_it_meant(tmp_path: Path) -> None:
    core, control = make_core(), ControlConfig(tip_speed=1.0)
    path = recorded(
        tmp_path / "session.rrd",
        core=SessionCore(core.world.model, msgspec.structs.replace(core.config, control=control)),
    )
    _, config = prepare(path, control=control)
    assert config.control == msgspec.structs.replace(control, solver=SOLVER_MINK)
    for other in (ControlConfig(tip_speed=2.0), msgspec.structs.replace(control, solver=SOLVER_NUMPY)):
        with pytest.raises(ConfigError, match="resumed session"):
            prepare(path, control=other)


def test_address_and_ports_are_those_of_the_recording_by_default(session: Path) -> None:
    listening = Listening("0.0.0.0", control_port=4001, state_port=4002, curve=True, beacon_port=0)
    keeper = ResumeNoteWriter(find_note_path(session))
    keeper.offer(ResumeNote("s1", listening, encode_handback(0)))
    keeper.close(5.0)
    past, config = prepare(session, control_port=5001)
    assert past.notes == []
    assert config.control == past.core.config.control
    assert dataclasses.replace(config, resume=None, control=ControlConfig()) == SessionConfig(
        "lab", "0.0.0.0", control_port=5001, state_port=4002, curve=True, beacon_port=0
    )


def test_rates_are_those_of_the_recording_by_default(tmp_path: Path) -> None:
    path = recorded(tmp_path / "session.rrd", settings=Settings(30.0, 2.0, False))
    _, config = prepare(path, keyframe_s=1.0)
    assert (config.state_hz, config.keyframe_s, config.realtime) == (30.0, 1.0, False)


@pytest.mark.parametrize("given", [{}, {"door": ((0.0, 0.0, 1.0), IDENTITY_QUAT)}])
def test_anchors_are_those_of_the_recording_by_default(tmp_path: Path, given: dict[str, PoseTuple]) -> None:
    """Also when a director moved one since."""
    table, moved = Pose((0.0, -0.45, 0.0), IDENTITY_QUAT), Pose((0.5, 0.0, 0.0), IDENTITY_QUAT)
    path = recorded(
        tmp_path / "session.rrd",
        core=make_core(anchors={"table": table}),
        said={40: [host(41 * TICK_NS, MoveAnchor(0, "table", moved))]},
        anchors={"table": table},
    )
    past, config = prepare(path, **({"anchors": given} if given else {}))
    now = {name: Pose(*T) for name, T in given.items()}
    assert (config.anchor_poses(), past.anchors) == (now or {"table": moved}, now)
    stepper = Stepper(
        past.core, Front(STEPS), None, lambda: LAST_NS + 10**9, 10**9, 10**10, b"",
        ResumedFrom(past.step, past.now_ns, past.anchors, past.is_gap_known),
    )  # fmt: skip
    stepper.step(1)
    assert past.core.authority.anchors == (now or {"table": moved})


def test_note_of_a_resumed_session_has_its_settings() -> None:
    wall = {"anchors": {"wall": ((1.0, 0.0, 1.0), IDENTITY_QUAT)}, "anchor_sizes": {"wall": 0.2}}
    recording = {"record_clouds_hz": 5.0, "record_assets": "all", "record_budget_bytes": 20_000_000}
    config = SessionConfig(state_hz=30.0, keyframe_s=2.0, realtime=False, adapt_media=False, **wall, **recording)  # type: ignore[arg-type]
    noted = make_settings(config)
    assert {name: getattr(config, name) for name in noted.__struct_fields__} == msgspec.structs.asdict(noted)


# --- tokens -----------------------------------------------------------------------------------------------------------


def test_tokens_stay_valid_and_connection_numbers_continue(session: Path) -> None:
    tokens = ResumeTokens(8)
    tokens.allocate_connection()
    token = tokens.issue("key", "p1")
    keeper = ResumeNoteWriter(find_note_path(session))
    keeper.offer(ResumeNote("s1", Listening(), tokens.encode()))
    keeper.close(5.0)
    assert token not in find_note_path(session).read_bytes(), "hashes only"
    assert find_note_path(session).stat().st_mode & 0o777 == 0o600
    past = PastSession(session)
    after = ResumeTokens(8, past.handback)
    assert after.find_participant(token, "key") == "p1"
    assert after.find_participant(token, "another key") is None
    assert after.allocate_connection() > ANN


@pytest.mark.parametrize("fault", ["another session", "open to others", "damaged", "nothing"])
def test_untrusted_note_is_ignored(session: Path, fault: str) -> None:
    path = find_note_path(session)
    if fault != "nothing":
        note = ResumeNote("s2" if fault == "another session" else "s1", Listening("9.9.9.9"))
        path.write_bytes(b"\xc1" if fault == "damaged" else msgspec.msgpack.encode(note))
        path.chmod(0o644 if fault == "open to others" else 0o600)
    note_read, why = read_note(session, "s1")
    assert note_read is None
    assert path.name in why


# --- time -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("header", [{"boot_id": "another"}, {"boot_id": ""}, {"origin_ns": 2**62}])
def test_session_time_after_a_reboot_continues_above_recorded_times(tmp_path: Path, header: dict[str, object]) -> None:
    past = PastSession(recorded(tmp_path / "session.rrd", **header))  # type: ignore[arg-type]
    now_ns = time.monotonic_ns() - past.origin_ns
    assert LAST_NS + MARGIN_NS <= now_ns < LAST_NS + 2 * MARGIN_NS
    assert not past.is_gap_known


# --- the first steps --------------------------------------------------------------------------------------------------


class SealedJournal(Journal):
    """Keeps what a recorder would write, ready for a file."""

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None:
        super().add_keyframe(seal_keyframe(keyframe, chain), chain)


@pytest.fixture
def gone_on(session: Path) -> tuple[Stepper, Front, Path]:
    """Forty steps after five seconds, recorded beside the first recording."""
    past = PastSession(session)
    now_ns = [LAST_NS + 5_000_000_000]

    def clock() -> int:
        now_ns[0] += TICK_NS // 2
        return now_ns[0]

    header = msgspec.structs.replace(past.header, continues=past.continues)
    front, journal = Front(STEPS), SealedJournal(past.core.config, b"")
    stepper = Stepper(
        past.core, front, journal, clock, 10**9, 10**10, header_root(header), ResumedFrom(past.step, past.now_ns)
    )  # fmt: skip
    stepper.inputs.post(Marker(0, "on we go"))
    for _ in range(40):
        stepper.step(1)
    past.close()
    return stepper, front, write(past.recording, header, Batch(rows=journal.rows, keyframes=journal.keyframes))


def test_both_recordings_verify_and_the_second_names_the_first(gone_on: tuple[Stepper, Front, Path]) -> None:
    _, _, path = gone_on
    report = verify_recording(path)
    assert report.ok, report.line()
    assert report.continues == f"session.rrd after step {STEPS - 1}"
    assert report.steps == 40
    assert report.last_step == STEPS + 39
    assert verify_recording(path.with_name("session.rrd")).ok
    past = PastSession(path)  # and on again
    assert (past.file, past.step) == ("session.resume2.rrd", STEPS + 39)
    past.close()


def test_continuation_of_a_different_recording_fails(gone_on: tuple[Stepper, Front, Path]) -> None:
    _, _, path = gone_on
    first = path.with_name("session.rrd")
    first.unlink()
    alone = verify_recording(path)
    assert alone.ok, "it verifies by itself"
    assert any("not there" in note for note in alone.notes)
    recorded(first, session_name="other")
    report = verify_recording(path)
    assert not report.ok
    assert "does not continue" in report.problems[0].text
