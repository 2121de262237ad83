"""The page of episodes: its list, its film strips, its buttons; and requests that it refuses."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from aiohttp import ClientResponse
from aiohttp.test_utils import TestClient, TestServer
from PIL import Image

from iris_session.cli.episodes_page import EpisodesPage
from iris_session.dataset.cameras import parse_cameras
from iris_session.dataset.episodes import Curation, EpisodeCuration, find_curation, read_curation
from iris_session.dataset.film_strip import HEIGHT, N_PICTURES, WIDTH
from iris_session.dataset.listing import list_recordings
from tests.dataset.support import record
from tests.replay.support import Played

TOKEN = "right"
RIGHT = {"X-Token": TOKEN}


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def talk(played: Played, folder: Path, ask: Callable[[TestClient], Awaitable[None]], cameras: str = "") -> None:  # type: ignore[type-arg]
    """Let `ask` talk to the page of a recording."""
    listed = list(list_recordings([played.path]))

    async def run() -> None:
        page = EpisodesPage(listed, parse_cameras(cameras), TOKEN, folder)
        async with TestClient(TestServer(page.make_app())) as client:
            await ask(client)

    asyncio.run(run())


def test_buttons_write_the_curation(played: Played, tmp_path: Path) -> None:
    before = played.path.read_bytes()

    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        async def decide(number: int, decision: str) -> Curation:
            content = {"recording": 0, "number": number, "decision": decision}
            answer = await client.post("/decide", json=content, headers=RIGHT)
            assert answer.status == 200
            shown = (await answer.json())["episodes"][number - 1]["edit"]
            curation = read_curation(played.path, played_id)
            assert shown.get("drop", False) == curation.episodes.get(number, EpisodeCuration()).drop
            return curation

        shown = await (await client.get("/episodes", headers=RIGHT)).json()
        played_id = shown["recordings"][0]["id"]
        assert [one["final_verdict"] for one in shown["recordings"][0]["episodes"]] == ["success", "failure", "success"]
        assert (await decide(1, "drop")).episodes == {1: EpisodeCuration(drop=True)}
        assert (await decide(2, "success")).episodes[2] == EpisodeCuration(label="success")
        assert (await decide(2, "failure")).episodes == {1: EpisodeCuration(drop=True)}, "as recorded: no decision"
        assert (await decide(1, "keep")).episodes == {}
        assert not find_curation(played.path).exists()

    talk(played, tmp_path, ask)
    assert played.path.read_bytes() == before


@pytest.mark.parametrize("cameras", ["", "operator,top=0,0,3->0,0,0"])
def test_film_strips_are_drawn(played: Played, tmp_path: Path, cameras: str) -> None:
    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        for camera in range(len(cameras.split("=")) if cameras else 1):
            answer = await client.get(f"/strips/0/2/{camera}", params={"token": TOKEN})
            assert (answer.status, answer.content_type) == (200, "image/jpeg")
            image = Image.open(io.BytesIO(await answer.read()))
            assert image.size == (N_PICTURES * WIDTH, HEIGHT)
        assert (await client.get("/strips/0/2/7", headers=RIGHT)).status == 404
        assert (await client.get("/strips/0/9/0", headers=RIGHT)).status == 404
        assert (await client.get("/strips/1/0/0", headers=RIGHT)).status == 404

    talk(played, tmp_path, ask, cameras)
    assert all(path.suffix == ".jpg" for path in tmp_path.iterdir())


def test_a_strip_that_cannot_be_drawn_says_why(played: Played, tmp_path: Path) -> None:
    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        answer = await client.get("/strips/0/0/0", headers=RIGHT)
        assert answer.status == 404
        assert "there is no camera 'wrist' in the scene" in await answer.text()

    talk(played, tmp_path, ask, "wrist")


def test_requests_without_the_token_are_refused(played: Played, tmp_path: Path) -> None:
    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        async def check(answer: ClientResponse) -> None:
            assert answer.status == 403
            assert played.path.name not in await answer.text()

        content = {"recording": 0, "number": 1, "decision": "drop"}
        for headers in ({}, {"X-Token": "wrong"}, {"X-Token": ""}, {"Cookie": f"token={TOKEN}"}):
            for path in ("/", "/episodes", "/strips/0/0/0", "/none", "/?token=wr%C3%B6ng"):
                await check(await client.get(path, headers=headers))
            await check(await client.post("/decide", json=content, headers=headers))
        answer = await client.get("/", params={"token": TOKEN})
        assert answer.status == 200
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert "NONCE" not in await answer.text()

    talk(played, tmp_path, ask)
    assert not find_curation(played.path).exists()


def test_no_request_names_a_file(played: Played, tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(b"secret")

    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        for path in ("0/0/..%2fsecret", "..%2f..%2fetc%2fpasswd/0/0", "0/%2e%2e/secret", "-1/0/0", "0/0/99999999999"):
            answer = await client.get(f"/strips/{path}?token={TOKEN}")
            assert answer.status == 404
            assert "secret" not in await answer.text()

    talk(played, tmp_path, ask)


@pytest.mark.parametrize(
    ("content", "status"),
    [
        (b"{", 400),
        (b'{"recording": 0, "number": 1, "decision": "drop", "path": "/etc/passwd"}', 400),
        (b'{"recording": -1, "number": 1, "decision": "drop"}', 400),
        (b'{"recording": 5, "number": 1, "decision": "drop"}', 400),
        (b'{"recording": 0, "number": 1, "decision": "erase"}', 400),
        (b'{"recording": 0, "number": 99, "decision": "drop"}', 409),
        (b'{"recording": 0, "number": 1, "decision": "' + b"x" * 5000 + b'"}', 413),
    ],
)
def test_other_decisions_are_refused(played: Played, tmp_path: Path, content: bytes, status: int) -> None:
    async def ask(client: TestClient) -> None:  # type: ignore[type-arg]
        assert (await client.post("/decide", data=content, headers=RIGHT)).status == status

    talk(played, tmp_path, ask)
    assert not find_curation(played.path).exists()
