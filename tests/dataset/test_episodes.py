"""Episodes of a set follow from verdicts and curation; recordings that do not fit are refused by the difference."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from iris_session.dataset.episodes import (
    Curation,
    DatasetError,
    EpisodeCuration,
    PlanOptions,
    find_curation,
    list_files,
    make_plan,
)
from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from iris_session.recording import Recording
from iris_session.session.core import SessionCore
from tests.dataset.support import NAME, record
from tests.session.play import make_core

ALL = PlanOptions(("success", "failure", "unknown"))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("played") / "session.rrd").path


def curate(path: Path, episodes: dict[int, EpisodeCuration], recording: str = "") -> None:
    with Recording.open(path) as opened:
        curation = Curation(recording or opened.root.hex(), episodes)
    find_curation(path).write_bytes(msgspec.json.encode(curation))


def test_successes_are_exported(path: Path) -> None:
    plan = make_plan([path])
    assert [(one.number, one.label, one.first_step, one.end_step) for one in plan.episodes] == [
        (1, "success", 20, 90),
        (3, "success", 160, 190),
    ]
    assert (plan.tasks, plan.people) == ((f"{NAME} lifts it",), (NAME,))
    assert plan.notes == ("session.rrd: episode 2 is left out: failure",)
    assert len(make_plan([path], ALL).episodes) == 3


def test_an_episode_that_does_not_end_is_unknown_and_discarded_ones_are_left_out(tmp_path: Path) -> None:
    episodes = {10: "start", 20: "discard", 21: "discard", 30: "start", 40: "success", 50: "start"}
    made = record(tmp_path / "session.rrd", episodes, steps=60)
    plan = make_plan([made.path], ALL)
    with Recording.open(made.path) as recording:
        labels = [one.label for one in recording.episodes]
    assert labels == ["discarded", "success", "unknown"]
    found = [(one.label, one.first_step, one.end_step) for one in plan.episodes]
    assert found == [("success", 30, 40), ("unknown", 50, 60)]
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(made.path.read_bytes()[:-3000])
    for choice, word in ((PlanOptions(), "left out: unknown"), (ALL, "not whole")):
        (note,) = (one for one in make_plan([cut], choice).notes if "episode 3" in one)
        assert word in note
        assert "the recording ends in the middle of it" in note


def test_a_recording_without_episodes_is_exported_as_a_whole_where_none_has_one(tmp_path: Path, path: Path) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=20)
    assert {one.recording for one in make_plan([made.path, path]).episodes} == {1}
    plan = make_plan([made.path])
    assert [(one.number, one.label, one.first_step, one.end_step) for one in plan.episodes] == [(0, "unknown", 0, 20)]
    assert "has no episodes: it is exported as a whole" in plan.notes[0]


def test_curation_decides(tmp_path: Path) -> None:
    made = record(tmp_path / "session.rrd")
    before = made.path.read_bytes()
    found = {
        1: EpisodeCuration(drop=True),
        2: EpisodeCuration(label="success", task="lift"),
        3: EpisodeCuration(trim=(0.01, 0.04)),
    }
    curate(made.path, found)
    plan = make_plan([made.path])
    assert [(one.number, one.label, one.task, one.trim) for one in plan.episodes] == [
        (2, "success", "lift", None),
        (3, "success", f"{NAME} lifts it", (0.01, 0.04)),
    ]
    assert made.path.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"[", "is no curation of a recording"),
        (b'{"recording": "RIGHT", "episodes": {"1": {"trimm": [0, 1]}}}', "is no curation of a recording"),
        (b'{"recording": "00ff", "episodes": {}}', "is the curation of another recording"),
        (b'{"recording": "RIGHT", "episodes": {"1": {"trim": [2, 1]}}}', "give two ascending times"),
        (b'{"recording": "RIGHT", "episodes": {"1": {"label": "good"}}}', "give success, failure, unknown"),
        (b'{"recording": "RIGHT", "episodes": {"9": {"drop": true}}}', "has no episode 9"),
    ],
)
def test_other_curation_is_refused(tmp_path: Path, content: bytes, problem: str) -> None:
    made = record(tmp_path / "session.rrd", {3: "start", 9: "success"}, steps=12)
    with Recording.open(made.path) as recording:
        right = recording.root.hex().encode()
    find_curation(made.path).write_bytes(content.replace(b"RIGHT", right))
    with pytest.raises(DatasetError, match=problem):
        make_plan([made.path])


def test_recordings_that_differ_are_refused_with_the_difference(tmp_path: Path, path: Path) -> None:
    one_arm = load_model(scene_path("handover"))
    one_arm.opt.timestep = 0.004
    other = record(tmp_path / "slow.rrd", {3: "start", 9: "success"}, steps=12, core=make_core(one_arm))
    assert len(make_plan([path, other.path]).episodes) == 3, "its header says the same rate"
    panda = make_core(load_model(scene_path("handover")))
    renamed = msgspec.structs.replace(panda.scene.robots[1], name="gripper")
    config = msgspec.structs.replace(panda.config, robots=(panda.scene.robots[0], renamed))
    core = SessionCore(panda.world.model, config)
    made = record(tmp_path / "renamed.rrd", {3: "start", 9: "success"}, steps=12, core=core)
    with pytest.raises(DatasetError, match=r"renamed.rrd does not fit .*: robots left, gripper, not left, right"):
        make_plan([path, made.path])
    assert len(make_plan([made.path]).episodes) == 1
    failed = record(
        tmp_path / "failed.rrd", {3: "start", 9: "failure"}, steps=12, core=SessionCore(panda.world.model, core.config)
    )
    assert len(make_plan([failed.path, path]).episodes) == 2, "nothing of it is exported"


def test_names_are_replaced(path: Path) -> None:
    plan = make_plan([path], PlanOptions(anonymise=True))
    assert (plan.tasks, plan.people) == (("p1 lifts it",), ("p1",))


def test_files_and_folders_are_listed(tmp_path: Path, path: Path) -> None:
    assert list_files([path.parent, path]) == [path]
    with pytest.raises(DatasetError, match="does not exist: give a recording"):
        list_files([tmp_path / "none.rrd"])
    with pytest.raises(DatasetError, match="there is no recording below the folder"):
        list_files([tmp_path])
