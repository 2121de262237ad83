"""Point clouds from a program to those who join later: a Python client, and the page in a real Chromium."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from iris_session import Client, StreamCamera, StreamInfo, encode_cloud
from tests.e2e.browser import Page
from tests.e2e.session_process import SessionProcess, wait_until

pytestmark = pytest.mark.e2e


def test_a_cloud_at_rest_reaches_who_joins_later(
    serve: Callable[..., SessionProcess], open_page: Callable[..., Page], tmp_path: Path
) -> None:
    server = serve("handover")
    side = np.linspace(-1.0, 1.0, 100)
    wall = np.stack(np.meshgrid(side, [-0.8], 1.0 + side, indexing="ij"), -1).reshape(-1, 3)
    pink = np.full(wall.shape, (255, 0, 255), np.uint8)
    frames = encode_cloud(wall, pink, voxel_m=0.02, error_m=0.01, classes=("full", "half", "quarter"))
    with Client(server.address, role="source", name="camera") as source:
        info = StreamInfo("The room", "all", StreamCamera(640, 480, 585.0, 585.0, 319.5, 239.5))
        wait_until(
            lambda: source.media.publish("room", frames, encoding="cloud", info=info), "the source has a connection"
        )
        wait_until(lambda: [one.stream for one in source.status().media] == ["room"], "the session has the cloud")

        with Client(server.address, role="observer", name="late") as late:
            room = late.media.cloud("room")
            wait_until(lambda: late.poll(0.05) and room.newest is not None, "the newest frame has come")
            cloud = room.poll()
            assert cloud is not None
            assert (room.feed.received, room.decoded, room.undecodable) == (1, 1, 0)
            assert len(cloud.positions) == 10_000
            times = cloud.times
            assert times.capture_ns <= times.sent_ns
            assert times.received_ns <= times.published_ns
            assert times.arrived_ns <= times.decoded_ns
            assert late.media.delivery is not None
            (told,) = late.media.delivery.streams
            assert (told.title, told.audience, told.camera, told.stale) == ("The room", "all", info.camera, False)
            assert (cloud.error_m, cloud.voxel_m) == pytest.approx((0.01, 0.02))

            page = open_page(server, "viewer")
            page.wait("irisSession.view.clouds.drawn.get('room') === 10000")
            wait_until(lambda: measure_share(page, tmp_path / "on.png") > 0.01, "the points are seen")
            page.evaluate("document.querySelector('#panel-streams input[type=checkbox]').click()")
            page.wait("irisSession.view.clouds.drawn.size === 0")
            wait_until(lambda: measure_share(page, tmp_path / "off.png") < 0.001, "the points are gone")
            wait_until(lambda: late.status().media[0].subscribers == 1, "the page gets no more frames")
            assert page.errors == []


def measure_share(page: Page, path: Path) -> float:
    """Return the share of the page that is in the colour of the points."""
    page.screenshot(path)
    picture = np.asarray(Image.open(io.BytesIO(path.read_bytes())).convert("RGB")).astype(int)
    return float(((picture[..., 0] > 200) & (picture[..., 1] < 80) & (picture[..., 2] > 200)).mean())
