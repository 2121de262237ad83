"""Pictures of cameras at a client: the newest one, decoded when it is asked for."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from iris_session.client import Client, ClientError
from iris_session.protocol.media import StreamBudget, StreamCamera
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import DeliveryBudget
from tests.client.session import ClientSession

Join = Callable[..., Client]
MS = 1_000_000


def make_jpeg(red: int, width: int = 32, height: int = 16) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height), (red, 0, 0)).save(file, "JPEG", quality=95)
    return file.getvalue()


@pytest.fixture(autouse=True)
def offered(session: ClientSession) -> None:
    camera = StreamCamera(32, 16, 10.0, 10.0, 15.5, 7.5)
    streams = (
        StreamBudget("left_wrist", encoding="jpeg", camera=camera, hz=30.0),
        StreamBudget("room", encoding="cloud"),
        StreamBudget("door", encoding="jpeg", detail="the cable is out"),
    )
    session.budget = DeliveryBudget(BudgetClass.FULL, streams=streams)


def test_the_newest_picture_is_decoded_when_it_is_read(session: ClientSession, join: Join) -> None:
    ann = join()
    wrist = ann.camera("left/wrist")
    ann.sleep(0.1)
    assert (wrist.read(), wrist.capture_ns, wrist.age_ns) == (None, None, None)
    assert (wrist.size, wrist.hz) == ((32, 16), 30.0)
    at_ns = session.now_ns - 40 * MS
    for red in (50, 100, 200):
        session.publish_media("left_wrist", make_jpeg(red), capture_ns=at_ns, encoding="jpeg")
    ann.poll()
    picture = wrist.read()
    assert picture is not None
    assert (picture.shape, picture.dtype, picture.flags.writeable) == ((16, 32, 3), np.uint8, False)
    assert picture[8, 16] == pytest.approx([200, 0, 0], abs=3)
    assert wrist.read() is picture
    assert (wrist.decoded, wrist.skipped, wrist.undecodable) == (1, 2, 0)
    assert wrist.capture_ns == at_ns
    assert wrist.age_ns == pytest.approx(40 * MS, abs=ann.clock_error_ns())


def test_waiting_is_for_a_newer_one(session: ClientSession, join: Join) -> None:
    ann = join()
    wrist = ann.camera("left/wrist")
    ann.sleep(0.1)
    session.publish_media("left_wrist", make_jpeg(50), encoding="jpeg")
    assert wrist.wait().shape == (16, 32, 3)
    with pytest.raises(ClientError, match=r"within 0\.2 s"):
        wrist.wait(0.2)
    session.publish_media("left_wrist", make_jpeg(99), encoding="jpeg")
    assert wrist.wait()[0, 0, 0] == pytest.approx(99, abs=3)
    with pytest.raises(ClientError, match="the cable is out"):
        ann.camera("door").wait(0.1)


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", make_jpeg(9)[:-200], make_jpeg(9, 5000, 16)])
def test_what_is_no_picture_leaves_the_one_before(session: ClientSession, join: Join, data: bytes) -> None:
    ann = join()
    wrist = ann.camera("left/wrist")
    ann.sleep(0.1)
    session.publish_media("left_wrist", make_jpeg(50), encoding="jpeg")
    before = wrist.wait()
    session.publish_media("left_wrist", data, encoding="jpeg")
    ann.poll()
    assert wrist.read() is before
    assert (wrist.undecodable, wrist.decoded) == (1, 1)
    with pytest.raises(ClientError, match="picture"):
        wrist.wait(0.1)


@pytest.mark.parametrize("name", ["top", "room", "", "x" * 99])
def test_a_camera_that_is_not_offered_is_an_error_that_lists_those_that_are(join: Join, name: str) -> None:
    with pytest.raises(ClientError, match=r"it offers left_wrist \(32x16 at 30 Hz\), door"):
        join().camera(name, 0.2)


def test_where_none_is_offered_the_error_says_how(session: ClientSession, join: Join) -> None:
    session.budget = DeliveryBudget(BudgetClass.FULL)
    with pytest.raises(ClientError, match="serve SCENE --picture CAMERA"):
        join().camera("wrist", 0.2)
