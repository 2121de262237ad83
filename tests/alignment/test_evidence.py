"""Evidence of several sheets is weighed: what a look that contradicts others means, through the live service."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.pose import PoseTuple, quat_from_yaw
from iris_session.protocol.entries import AlignmentProposal
from tests.alignment.emulated_headsets import SECOND, Lab, Wearer, error_at_anchor
from tests.anchors.worlds import shifted

SHEETS: dict[str, PoseTuple] = {
    "a": ((0.0, 0.0, 0.7), quat_from_yaw(0.1)),
    "b": ((1.5, 0.0, 0.7), quat_from_yaw(2.0)),
    "c": ((0.75, 1.3, 0.7), quat_from_yaw(-1.0)),
}


def look(ann: Wearer, sheets: Iterable[str]) -> list[AlignmentProposal]:
    """Look at sheets from a new place each; return the proposals, the last of which is in force after each look."""
    before = len(ann.proposals())
    for name in sheets:
        got = len(ann.proposals())
        ann.report_observations(ann.place(name, 0.6), 10, name)
        ann.lab.now_ns += SECOND
        ann.lab.poll(2)
        if len(ann.proposals()) > got:
            ann.accept()
    return ann.proposals()[before:]


def find_refusal(ann: Wearer) -> str:
    """Return the advice of the newest proposal, which is a refusal."""
    newest = [e.message for e in ann.entries() if isinstance(e.message, AlignmentProposal)][-1]
    assert newest.refused
    return newest.advice


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.permutations("aabbcc"), st.sampled_from(["moved", "swapped"]))
def test_no_order_of_looking_at_the_same_sheets_ends_elsewhere(order: list[str], what: str) -> None:
    """Two sheets agree; the third one lies elsewhere, by 50 mm or by a metre."""
    lab = Lab(SHEETS)
    ann = lab.wearer()
    lab.world["c"] = shifted(SHEETS["c"], (0.05, 0.0, 0.0) if what == "moved" else (0.0, -1.0, 0.0))
    newest = look(ann, order)[-1]
    assert all(error_at_anchor(ann, newest, name) < 0.012 for name in "ab")
    assert "'c'" in newest.advice


@pytest.mark.parametrize("names", ["ab", "abc"])
def test_moved_tracking_frame_is_known_by_two_sheets(names: str) -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    look(ann, names)
    lab.now_ns += 30 * SECOND
    ann.bump(0.05, 0.03)
    assert look(ann, "aa") == [], "one sheet cannot tell"
    assert [(a.kind, a.anchor_id, a.beside) for a in ann.alarms()] == [("differs", "a", ())]
    assert "'b'" in find_refusal(ann)
    newest = look(ann, "b")[-1]
    assert all(error_at_anchor(ann, newest, name) < 0.012 for name in "ab")


@pytest.mark.parametrize("names", ["ab", "abc"])
def test_moved_sheet_is_known_by_a_look_at_another(names: str) -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    look(ann, names)
    lab.now_ns += 30 * SECOND
    lab.world["a"] = shifted(SHEETS["a"], (0.0, 0.05, 0.0))
    assert look(ann, "a") == [], "one sheet cannot tell"
    newest = look(ann, "b")[-1]
    assert error_at_anchor(ann, newest, "b") < 0.012
    assert "'a'" in newest.advice
    assert all(error_at_anchor(ann, one, "b") < 0.012 for one in look(ann, "aaa"))
    lab.world["a"] = SHEETS["a"]
    assert "'a'" not in look(ann, "aa")[-1].advice, "it was put back"


@pytest.mark.parametrize("order", ["ab", "ba", "aaab", "abab", "bbba"])
def test_two_sheets_that_contradict_each_other_have_no_majority(order: str) -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    lab.world["b"] = shifted(SHEETS["b"], (0.0, 0.0, 0.05))
    look(ann, order)
    assert [a.beside for a in ann.alarms()] == [()]
    advice = find_refusal(ann)
    assert all(name in advice for name in "ab")


def test_estimate_that_the_newest_look_contradicts_is_as_old_as_the_looks_that_agree() -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    lab.world["c"] = shifted(SHEETS["c"], (0.05, 0.0, 0.0))
    looked_ns = look(ann, "aabb")[-1].looked_ns
    lab.now_ns += 60 * SECOND
    ann.report_observations(ann.place("c", 0.6), 10, "c")
    assert "c" in ann.proposals()[-1].moved
    assert ann.proposals()[-1].looked_ns <= looked_ns


@pytest.mark.parametrize("names", ["ab", "abab"])
def test_looks_before_a_silent_jump_do_not_outvote_a_sheet_seen_after_it(names: str) -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    look(ann, names)
    lab.now_ns += 20 * SECOND
    ann.bump(0.05, 0.03)
    look(ann, "c")
    assert [(a.kind, a.anchor_id, a.beside) for a in ann.alarms()] == [("differs", "c", ())], "no other vouches"
    assert look(ann, "a") == [], "one sheet cannot tell"
    newest = look(ann, "b")[-1]
    assert all(error_at_anchor(ann, newest, name) < 0.012 for name in "abc")


def test_a_sheet_that_is_known_to_be_moved_vouches_for_no_frame() -> None:
    lab = Lab(SHEETS)
    ann = lab.wearer()
    lab.world["c"] = shifted(SHEETS["c"], (0.05, 0.0, 0.0))
    look(ann, "ababc")
    known = len(ann.alarms())
    lab.now_ns += 30 * SECOND
    ann.bump(0.05, 0.03)
    views = {name: ann.place(name, p_head_world=(0.4, 0.5, 1.4)) for name in "ca"}
    for _ in range(20):
        lab.now_ns += SECOND // 10
        for name, view in views.items():
            ann.report_observation(view, name)
        lab.poll(2)
    assert [(a.anchor_id, a.beside) for a in ann.alarms()[known:]][:1] == [("a", ())]


@pytest.mark.parametrize(("too_far", "seed"), [(0.05, 1), (-0.05, 2), (0.05, 3), (-0.05, 4)])
def test_a_wrong_focal_length_is_told_from_a_jump(too_far: float, seed: int) -> None:
    """Seen from near by, then from the other side: all is explained by the camera, and nothing is forgotten."""
    lab = Lab({"a": SHEETS["a"]})
    ann = lab.wearer(seed=seed)
    ann.too_far = too_far
    for head in ((0.3, 0.1, 1.1), (-0.6, 0.2, 1.5), (0.1, -0.5, 1.5)):
        ann.report_observations(ann.place("a", p_head_world=head), 20, "a")
        newest = ann.accept()
        assert error_at_anchor(ann, newest, "a") < 3.0 * newest.error_at_anchor_m
    assert error_at_anchor(ann, newest, "a") < 0.012
    assert newest.n_viewpoints == 3
    assert "camera" in newest.advice
    assert ann.alarms() == []


@pytest.mark.parametrize("source", ["my_detector", "touch", "holder"])
def test_a_source_that_does_not_fit_states_the_largest_error(source: str) -> None:
    def measure(name: str) -> float:
        lab = Lab(SHEETS)
        ann = lab.wearer(seed=3)
        view = ann.place("a", 0.6)
        for _ in range(10):
            lab.now_ns += SECOND // 10
            ann.report_observation(view, "a", source=name)
        lab.poll(2)
        return ann.proposals()[-1].error_at_anchor_m

    assert measure(source) == measure("qr_system") >= measure("qr_camera") == measure("")
