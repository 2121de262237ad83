"""Sheets solved together: exact without noise, robust, saved and read back, moved sheets are named."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.constellation import Constellation, ConstellationError, SheetObservation, find_moved, solve_constellation
from anchors.pose import PoseTuple, distance, quat_angle, quat_from_rotvec, quat_from_yaw, quat_mul
from tests.anchors.worlds import Viewpoint, shifted, tracking_frame, viewpoint_around

ROOM: dict[str, PoseTuple] = {
    "door": ((0.0, 0.0, 0.8), quat_from_yaw(0.2)),
    "left": ((1.5, 0.1, 0.8), quat_from_yaw(2.9)),
    "right": ((0.7, 1.3, 0.75), quat_from_yaw(-1.4)),
    "wall": ((2.2, 1.0, 1.3), quat_mul(quat_from_yaw(1.0), quat_from_rotvec((1.4, 0.0, 0.0)))),
}


def _observations(
    room: dict[str, PoseTuple], plan: dict[str, str], seed: int = 0, noise: float = 1.0, repeat: int = 10
) -> list[SheetObservation]:
    """Observations by plan: headset -> initials of the sheets it observes, one viewpoint each."""
    rng = np.random.default_rng(seed)
    by_initial = {name[0]: name for name in room}
    out = []
    for who, initials in plan.items():
        T = tracking_frame(rng, 0.2 * noise)
        for viewpoint, initial in enumerate(initials):
            name = by_initial[initial]
            view = Viewpoint(rng, room[name], viewpoint_around(rng, room[name][0], rng.uniform(0.4, 0.9)), noise)
            for _ in range(repeat):
                out.append(SheetObservation(who, 0, viewpoint, name, view.observe(T), view.head_pose(T)))
    return out


def test_exact_without_noise_from_several_headsets() -> None:
    got = solve_constellation(_observations(ROOM, {"a": "dl", "b": "lr", "c": "rwd"}, noise=0.0), "door", ROOM["door"])
    for name, T in ROOM.items():
        found = got.constellation.anchors[name]
        assert distance(found[0], T[0]) < 1e-6
        assert quat_angle(found[1], T[1]) < 1e-6
    assert got.rejected == ()
    assert len(got.T_world_tracking) == 3


def test_stated_error_covers_noisy_observations() -> None:
    inside, tried = 0, 0
    for seed in range(8):
        got = solve_constellation(_observations(ROOM, {"a": "dlrwdlrw", "b": "wrldwrld"}, seed), "door", ROOM["door"])
        for name in ("left", "right", "wall"):
            off = distance(got.constellation.anchors[name][0], ROOM[name][0])
            assert off < 0.03
            inside += off <= got.constellation.error_m[name]
            tried += 1
    assert inside >= 0.85 * tried


def test_outlier_is_named_and_excluded() -> None:
    seen = _observations(ROOM, {"a": "dlrwdlrw", "b": "dlrwdlrw"}, 4)
    wrong = [
        SheetObservation(
            o.headset, 0, o.viewpoint_id, o.anchor_id, shifted(o.T_tracking_anchor, (0.2, 0.1, 0.0)), o.p_tracking_head
        )
        if (o.headset, o.viewpoint_id) == ("b", 2)
        else o
        for o in seen
    ]
    got = solve_constellation(wrong, "door", ROOM["door"])
    assert got.rejected == (("b", 0, 2, "right"),)
    assert max(got.residuals_m.values()) < 0.01
    for name, T in ROOM.items():
        assert distance(got.constellation.anchors[name][0], T[0]) < 0.02


def test_unconnected_sheets_are_named() -> None:
    with pytest.raises(ConstellationError, match="'door': right, wall"):
        solve_constellation(_observations(ROOM, {"a": "dl", "b": "rw"}), "door")
    with pytest.raises(ConstellationError, match=r"'roof'.*: door, left"):
        solve_constellation(_observations(ROOM, {"a": "dl"}), "roof")


def _saved(anchors: dict[str, PoseTuple]) -> Constellation:
    return Constellation("door", anchors, dict.fromkeys(anchors, 0.002), {"door": 0.16})


def test_save_and_read_round_trip() -> None:
    saved = _saved(ROOM)
    back = Constellation.from_toml(saved.to_toml())
    assert back.reference == "door"
    quoted = dict.fromkeys(['the "big" one', "back\\slash", "T\u00fcr"], ROOM["door"])
    assert Constellation.from_toml(Constellation("T\u00fcr", quoted, {}, {}).to_toml()).anchors.keys() == quoted.keys()
    assert back.sizes == saved.sizes
    assert back.error_m == saved.error_m
    for name, (p, q) in ROOM.items():
        assert back.anchors[name][0] == p
        assert np.allclose(back.anchors[name][1], q, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("format = ", "not a TOML file"),
        ("format = 2", "reads format = 1"),
        ("format = 1", "reference"),
        ('format = 1\nreference = "x"\n[anchors.y]\nposition_m = [0, 0, 0]', "their names"),
        ('format = 1\nreference = "x"\n[anchors.x]\nposition_m = [0, 0]', "position_m"),
        (
            'format = 1\nreference = "x"\n[anchors.x]\nposition_m = [0, 0, nan]\nquaternion_wxyz = [1, 0, 0, 0]',
            "finite",
        ),
        (
            'format = 1\nreference = "x"\n[anchors.x]\nposition_m = [0, 0, 0]\nquaternion_wxyz = [1, 1, 0, 0]',
            "no unit quaternion",
        ),
        (
            'format = 1\nreference = "x"\n[anchors.x]\nposition_m = [0, 0, 0]\nquaternion_wxyz = [1, 0, 0, 0]\n'
            "size_mm = 160",
            "size_mm",
        ),
        (
            'format = 1\nreference = "x"\n[anchors.x]\nposition_m = [0, 0, 0]\nquaternion_wxyz = [1, 0, 0, 0]\n'
            "size_m = -1",
            "size_m",
        ),
    ],
)
def test_invalid_files_are_rejected_with_reason(text: str, word: str) -> None:
    with pytest.raises(ConstellationError, match=word):
        Constellation.from_toml(text)


def test_moved_sheet_is_named_also_when_it_is_the_reference() -> None:
    saved = _saved(ROOM)
    assert find_moved(saved, _saved(ROOM)) == ()
    for name in ("left", "door"):
        now = _saved({**ROOM, name: shifted(ROOM[name], (0.03, 0.0, 0.0))})
        (moved,) = find_moved(saved, now)
        assert moved.anchor_id == name
        assert moved.distance_m == pytest.approx(0.03, abs=1e-6)
    turned = {**ROOM, "wall": (ROOM["wall"][0], quat_mul(quat_from_yaw(math.radians(4.0)), ROOM["wall"][1]))}
    assert [m.anchor_id for m in find_moved(saved, _saved(turned))] == ["wall"]


def test_moved_sheet_of_two_is_ambiguous() -> None:
    two = {name: ROOM[name] for name in ("door", "left")}
    now = {**two, "left": shifted(ROOM["left"], (0.1, 0.0, 0.0))}
    with pytest.raises(ConstellationError, match="no majority"):
        find_moved(_saved(two), _saved(now))
    with pytest.raises(ConstellationError, match="2 are needed"):
        find_moved(_saved(two), Constellation("wall", {"wall": ROOM["wall"]}, {}, {}))


def test_sheet_without_fitting_observations_is_named_and_has_no_stated_error() -> None:
    """Two headsets observed it at two places: with both excluded nothing holds it, which is no error of 0 mm."""
    seen = _observations(ROOM, {"a": "drw", "b": "drw"}, 4)
    torn = [
        SheetObservation(
            o.headset,
            0,
            o.viewpoint_id,
            o.anchor_id,
            shifted(o.T_tracking_anchor, (0.0, 0.0, 0.0 if o.headset == "a" else 0.4)),
            o.p_tracking_head,
        )
        if o.anchor_id == "right"
        else o
        for o in seen
    ]
    with pytest.raises(ConstellationError, match=r"right.* contradicts"):
        solve_constellation(torn, "door", ROOM["door"])


def test_invalid_poses_are_excluded() -> None:
    seen = _observations(ROOM, {"a": "dlrw"}, 4)
    bad = [SheetObservation("a", 0, 0, "door", (ROOM["door"][0], (math.nan, 0.0, 0.0, 0.0))), *seen]
    assert solve_constellation(bad, "door").constellation == solve_constellation(seen, "door").constellation
