"""Recordings that were made once and are kept: every later version reads and verifies them.

They are of the scene `handover`, with an agent that drives the left arm for a second: `closed` by `serve`, with an
index; `open` by a script with `Session.attach`, without one; `killed` by `serve`, whose recorder got SIGKILL.
"""

from __future__ import annotations

import lzma
from pathlib import Path

import msgspec
import numpy as np
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.bench.stop import make_wall_robot
from iris_session.control import ControlConfig
from iris_session.protocol.client_messages import Sample
from iris_session.recording import CLOSED, OPEN, Recording, summarise
from iris_session.recording.records import iterate_samples
from iris_session.session.core import CoreConfig
from iris_session.session.verification import decode_recorded_config, verify_recording

DATA = Path(__file__).parent / "data"
#: Parts of the environment in which two machines may differ without another result of a step.
HARMLESS = ("iris-session", "rerun-sdk", "python", "platform", "implementation")


def unpack(name: str, folder: Path) -> Path:
    path = folder / "session.rrd"
    path.write_bytes(lzma.decompress((DATA / f"{name}.rrd.xz").read_bytes()))
    return path


@pytest.mark.parametrize(
    ("name", "recording_class", "steps", "finished"),
    [("closed", CLOSED, 1044, True), ("open", OPEN, 437, True), ("killed", CLOSED, 960, False)],
)
def test_kept_recording_verifies(name: str, recording_class: str, steps: int, finished: bool, tmp_path: Path) -> None:
    path = unpack(name, tmp_path)
    report = verify_recording(path)
    assert (report.recording_class, report.last_step, report.finished) == (recording_class, steps - 1, finished)
    assert not report.damage + report.missing + report.gaps
    libraries = [line for line in report.version_differences if not line.startswith(HARMLESS)]
    if not libraries:  # others may round in another way
        assert report.ok, report.line()
        assert (report.steps, report.keyframes) == (steps, 1)
    assert not [one for one in report.problems if one.kind != "divergence"]


@pytest.mark.parametrize("name", ["closed", "open", "killed"])
def test_kept_recording_reads(name: str, tmp_path: Path) -> None:
    with Recording.open(unpack(name, tmp_path)) as recording:
        summary = summarise(recording)
        assert (summary.ok, [one.name for one in summary.people]) == (True, ["policy"])
        assert summary.people[0].held_s["left"] > 0.5
        assert (summary.assets.present, summary.assets.expected) == (3, 3)
        states = list(recording.states())
        assert len(states) > 20
        assert all(np.isfinite(state.poses).all() for state in states)
        assert {type(one.sample) for one in iterate_samples(recording)} == {Sample}
        assert any(one.participant for one in iterate_samples(recording))


def test_what_a_header_does_not_name_was_not_in_force() -> None:
    """Recordings of before have no such fields; what a later header says counts."""
    robot = make_wall_robot("position_weak")
    config = CoreConfig(AuthorityConfig(), ControlConfig(), (robot,), ())
    fields = msgspec.msgpack.decode(msgspec.msgpack.encode(config))
    assert decode_recorded_config(msgspec.msgpack.encode(fields)).control.compensate_sag
    del (
        fields["authority"]["explains"],
        fields["authority"]["self_rename"],
        fields["control"]["compensate_sag"],
        fields["control"]["few_joints_orientation_cost"],
    )
    recorded = decode_recorded_config(msgspec.msgpack.encode(fields))
    assert (recorded.authority.explains, recorded.authority.self_rename) == (False, False)
    control = recorded.control
    assert (control.compensate_sag, control.few_joints_orientation_cost) == (False, None)
