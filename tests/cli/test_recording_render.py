"""`recording render`: files that play and hold what was drawn, and one line for what cannot be done."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow
from PIL import ImageSequence

from iris_session.recording import Recording
from iris_session.replay.pictures import Image, PictureOptions, RecordingPictures, Timeline
from tests.cli.conftest import CommandLine
from tests.replay.support import Played, make_drawn_core, play, step_ns

SIZE = ("--size", "160x120")


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    made = play(tmp_path_factory.mktemp("played") / "session.rrd", 60, core=make_drawn_core())
    made.write()
    return made


def render(path: Path, out: Path, *options: str) -> tuple[object, ...]:
    """Return the words of the command."""
    return "recording", "render", path, "-o", out, *SIZE, *options


def draw(played: Played, times_ns: Sequence[int], camera: str = "operator") -> list[Image]:
    with (
        Recording.open(played.path) as recording,
        RecordingPictures(recording, Timeline(recording), PictureOptions(160, 120, camera)) as made,
    ):
        return list(made.draw(times_ns))


def test_a_video_holds_the_pictures_in_order(played: Played, tmp_path: Path, cli: CommandLine) -> None:
    out = tmp_path / "session.mp4"
    cli.run(*render(played.path, out, "--camera", "operator", "--fps", "100", "--json"))
    assert cli.err == ""
    begin_ns, end_ns = step_ns(0), step_ns(59)
    times = range(begin_ns, end_ns + 1, 10_000_000)
    assert json.loads(cli.out) == {
        "file": str(out),
        "pictures": len(times),
        "begin_s": times[0] * 1e-9,
        "end_s": pytest.approx(times[-1] * 1e-9),
        "codec": "VP9",
        "width": 160,
        "height": 120,
        "bytes": out.stat().st_size,
        "notes": [],
        "problems": [],
    }
    video = cv2.VideoCapture(str(out))
    assert video.get(cv2.CAP_PROP_FPS) == 100.0
    drawn = draw(played, times)
    for image in drawn:
        found, frame = video.read()
        assert found
        assert np.abs(frame[..., ::-1].astype(int) - image).mean() < 4.0, "as a lossy codec has it"
    assert not video.read()[0]
    assert os.listdir(tmp_path) == ["session.mp4"]


def test_a_picture_is_exactly_what_was_drawn(played: Played, tmp_path: Path, cli: CommandLine) -> None:
    out = tmp_path / "one.png"
    cli.run(*render(played.path.parent, out, "--at", "0.1s", "--camera", "side"))
    assert cli.out.startswith(f"{out}: the picture of 0.10 s, 160 x 120, PNG, ")
    (drawn,) = draw(played, [100_000_000], "side")
    assert cv2.imread(str(out))[..., ::-1].tobytes() == drawn.tobytes()
    cli.run(*render(played.path, out), status=2)
    assert cli.err == f"iris-session: {out} exists: give another file, or --force\n"
    cli.run(*render(played.path, out, "--force"))


def test_an_animation_has_its_times(played: Played, tmp_path: Path, cli: CommandLine) -> None:
    out = tmp_path / "session.gif"
    cli.run(*render(played.path, out, "--from", "0", "--to", "0.1", "--fps", "10", "--speed", "0.2"))
    with Pillow.open(out) as animation:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(animation)]  # of equal ones the sum
        assert len(durations) >= 2
        assert sum(durations) == 5 * 100
        assert animation.info["loop"] == 0


def test_cameras_are_listed(played: Played, cli: CommandLine) -> None:
    assert cli.run("recording", "render", played.path, "--list-cameras") == "operator\nside\n"
    assert cli.json("recording", "render", played.path, "--list-cameras") == {"cameras": ["operator", "side"]}


@pytest.mark.parametrize(
    ("out", "options", "line"),
    [
        ("x.avi", (), "is of a kind that is not written: give -o FILE.mp4, FILE.gif or FILE.png"),
        ("none/x.mp4", (), "does not exist: make it, or give another one"),
        ("x.mp4", ("--camera", "top"), "there is no camera 'top' in the scene, there are 'operator', 'side'"),
        ("x.mp4", ("--size", "161x120"), "--size 161x120: a video needs even numbers"),
        ("x.mp4", ("--at", "0.1"), "--at is for one picture (.png): give --from and --to"),
        ("x.mp4", ("--from", "9"), "--from 9 is after the end, 0.12 s: give an earlier one, or a later --to"),
        ("x.mp4", ("--from", "3", "--to", "4"), "nothing there, it goes from 0.00 s to 0.12 s"),
        (
            "x.gif",
            ("--speed", "0.01", "--size", "1280x720"),
            "is too large: give --from and --to, a smaller --size or --fps, or a .mp4",
        ),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    played: Played, tmp_path: Path, cli: CommandLine, out: str, options: Sequence[str], line: str
) -> None:
    assert cli.refuse(*render(played.path, tmp_path / out, *options)).endswith(f"{line}\n")
    assert not os.listdir(tmp_path)


def test_damage_is_said_and_is_a_status(tmp_path: Path, cli: CommandLine) -> None:
    gap = play(tmp_path / "session.rrd", 45, core=make_drawn_core())
    del gap.batch.rows[30]
    path = gap.write()
    cli.run(*render(path, tmp_path / "x.mp4", "--fps", "100"), status=1)
    assert cli.err == f"iris-session: {path} is damaged: steps 30 to 39 are left out\n"
    assert (tmp_path / "x.mp4").stat().st_size > 0


@pytest.mark.parametrize("kind", [".mp4", ".gif"])
def test_ctrl_c_leaves_the_old_file_and_nothing_else(
    kind: str, played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: CommandLine
) -> None:
    out = tmp_path / f"x{kind}"
    out.write_text("old")
    inside: list[list[str]] = []

    def interrupt(self: Any, times_ns: Sequence[int]) -> Iterator[Image]:
        yield np.zeros((120, 160, 3), np.uint8)
        inside.append(os.listdir(tmp_path))
        raise KeyboardInterrupt

    monkeypatch.setattr(RecordingPictures, "draw", interrupt)
    cli.run(*render(played.path, out, "--force", "--fps", "100"), status=130)
    assert len(inside[0]) == 2, "it is written beside the old one"
    assert os.listdir(tmp_path) == [out.name]
    assert out.read_text() == "old"
