"""Clouds and pictures from a program to the page in a real Chromium."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from PIL import Image

from iris_session import Client, StreamInfo, encode_cloud
from tests.e2e.browser import Page
from tests.e2e.session_process import SessionProcess, wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.long]

PINK: Final = (255, 0, 255)
GREEN: Final = (0, 220, 60)
HZ: Final = 5.0


def make_wall(color: tuple[int, int, int]) -> dict[str, bytes]:
    """Return the frames of a wall of 10,000 points behind the robots."""
    side = np.linspace(-1.0, 1.0, 100)
    wall = np.stack(np.meshgrid(side, [-0.8], 1.0 + side, indexing="ij"), -1).reshape(-1, 3)
    colors = np.full(wall.shape, color, np.uint8)
    return encode_cloud(wall, colors, voxel_m=0.02, error_m=0.01, classes=("full", "half", "quarter"))


def make_picture(width: int, height: int, color: tuple[int, int, int]) -> bytes:
    """Return a JPEG image of one colour."""
    stream = io.BytesIO()
    Image.new("RGB", (width, height), color).save(stream, "JPEG", quality=90)
    return stream.getvalue()


class Camera:
    """A program in a thread of its own: publishes a picture and a cloud `HZ` times a second, or `bad` for a picture."""

    def __init__(self, address: str) -> None:
        self.fault = self.detail = ""
        self.bad: bytes | None = None
        self.published = 0
        self.silent = False  # publishes nothing, but stays
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(address,))
        self._thread.start()

    def stop(self) -> None:
        """Leave the session."""
        self._ends.set()
        self._thread.join()

    def _run(self, address: str) -> None:
        picture, wall = make_picture(320, 240, GREEN), make_wall(PINK)
        with Client(address, role="source", name="camera") as source:
            while not self._ends.wait(1.0 / HZ):
                source.poll()
                if self.silent:
                    continue
                info = StreamInfo("The <b>room</b>", "remote", None, HZ, self.fault, self.detail)
                source.media.publish("room", wall, encoding="cloud", info=info)
                info = StreamInfo("Front camera", "remote", None, HZ, self.fault, self.detail)
                shown = picture if self.bad is None else self.bad
                self.published += source.media.publish("front", shown, encoding="jpeg", info=info)


def publish_bad(camera: Camera, page: Page) -> None:
    """Publish pictures that are none, each until the page has refused it: it takes only the newest one."""
    picture = make_picture(4, 4, PINK)
    refused = "(irisSession.state.stats.media.front?.refused ?? 0)"
    for bad in (b"no picture", picture[: len(picture) // 2], make_picture(5000, 4, PINK)):
        before = page.evaluate(refused)
        camera.bad = bad
        page.wait(f"{refused} > {before}")
        camera.bad = None
        # What is left of it must not count for the next one.
        at = page.evaluate("irisSession.state.stats.media.front.received")
        page.wait(f"irisSession.state.stats.media.front.received > {at} + 1")


@contextlib.contextmanager
def run_camera(server: SessionProcess) -> Iterator[Camera]:
    camera = Camera(server.address)
    try:
        yield camera
    finally:
        camera.stop()


def test_a_camera_is_seen_in_the_page_and_said_to_be_faulty_and_stale(
    serve: Callable[..., SessionProcess], open_page: Callable[..., Page], tmp_path: Path
) -> None:
    server = serve("handover")
    panel = "document.querySelector('[data-stream=front].picture')"
    with run_camera(server) as camera, Client(server.address, role="observer", name="host") as host:
        page = open_page(server, "viewer", width=900, height=500)
        page.wait("irisSession.state.budget?.streams.length === 2")
        page.wait("irisSession.view.clouds.drawn.get('room') === 10000")
        page.evaluate("document.querySelector('#panel-streams').open = true")
        page.wait("document.querySelector('#panel-streams [data-stream=room]').innerText.includes('The <b>room</b>')")
        wait_until(lambda: measure_share(page, PINK, tmp_path / "cloud.png") > 0.01, "the cloud is seen")

        def count_subscribers() -> int:
            return next(one.subscribers for one in host.status().media if one.stream == "front")

        assert count_subscribers() == 0  # no panel is open
        page.evaluate("document.querySelector('#panel-streams').open = false")
        page.evaluate("document.querySelector('.menu').open = true")
        page.check("Front camera")
        page.evaluate("document.querySelector('.menu').open = false")
        wait_until(lambda: measure_share(page, GREEN, tmp_path / "picture.png") > 0.03, "the picture is seen")
        wait_until(lambda: count_subscribers() == 1, "the page subscribed")
        page.wait(f"/ old$/.test({panel}.querySelector('.age').textContent)")

        camera.bad, published = b"", camera.published
        wait_until(lambda: camera.published > published + 1, "an empty picture is published")
        publish_bad(camera, page)

        camera.detail, camera.fault = "by <b>3 cm</b>", "moved"
        page.wait(f"{panel}.innerText.includes('its camera was moved: calibrate it again: by <b>3 cm</b>')")
        wait_until(lambda: measure_share(page, GREEN, tmp_path / "faulty.png") < 0.001, "the picture is dimmed")
        wait_until(lambda: measure_share(page, PINK, tmp_path / "faulty.png") < 0.001, "the cloud is dimmed")
        camera.detail = camera.fault = ""
        wait_until(lambda: measure_share(page, GREEN, tmp_path / "mended.png") > 0.03, "the picture is good again")

        camera.silent = True
        page.wait(f"{panel}.innerText.includes('stale') && {panel}.classList.contains('bad')")
        page.wait("document.querySelector('#panel-streams .count').textContent === '2 · 2 with a problem'")
        wait_until(lambda: measure_share(page, PINK, tmp_path / "stale.png") < 0.001, "the stale cloud is dimmed")
        page.evaluate("document.querySelector('#panel-streams').open = true")
        page.wait("document.querySelector('#panel-streams [data-stream=front]').innerText.includes('stale')")
        page.evaluate("document.querySelector('#panel-streams [data-stream=front] input').click()")
        page.wait(f"{panel} === null")
        wait_until(lambda: count_subscribers() == 0, "a closed panel is not subscribed to")
        camera.stop()
        page.wait("irisSession.state.budget.streams.length === 0 && irisSession.view.clouds.drawn.size === 0")
        assert page.errors == []


def measure_share(page: Page, color: tuple[int, int, int], path: Path) -> float:
    """Return the share of the page that is in a colour."""
    page.screenshot(path)
    picture = np.asarray(Image.open(io.BytesIO(path.read_bytes())).convert("RGB")).astype(int)
    return float((np.abs(picture - color).max(-1) < 60).mean())
