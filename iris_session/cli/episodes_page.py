"""The page of `iris-session recording episodes --page`: the list with film strips, and buttons that write curations.

It listens on this machine alone, and every request needs the token that is in its address. Recordings and pictures are
named by numbers: no request names a file.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import signal
import tempfile
import webbrowser
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import msgspec
from aiohttp import web
from PIL import Image

from iris_session.cli.common import CommandError, to_printable
from iris_session.dataset.cameras import CameraSpec
from iris_session.dataset.curation import Edits, edit_curation, write_curation
from iris_session.dataset.episodes import FAILURE, SUCCESS
from iris_session.dataset.film_strip import draw_strips
from iris_session.dataset.listing import ListedRecording, attach_edits, read_lengths
from iris_session.protocol.errors import IrisError

HOST: Final = "127.0.0.1"
KEEP: Final = "keep"
DROP: Final = "drop"
DECISIONS: Final = (KEEP, DROP, SUCCESS, FAILURE)
_POLICY: Final = (
    "default-src 'none'; img-src 'self' data:; connect-src 'self'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class ButtonPress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Message of a button. `recording`: its index in the list; `number`: of the episode; one of `DECISIONS`."""

    recording: int
    number: int
    decision: str


class EpisodesPage:
    """Answers the requests of the page.

    Args:
        listed: The recordings, without edits.
        cameras: Those of the film strips; none: a view of all that moves.
        token: Every request must have it.
        folder: For pictures.
    """

    def __init__(
        self, listed: Sequence[ListedRecording], cameras: Sequence[CameraSpec], token: str, folder: Path
    ) -> None:
        self._listed, self._cameras, self._token, self._folder = listed, cameras, token, folder
        self._drawn: dict[int, str] = {}  # by index of the recording: why there is no picture, empty if there are
        self._artist = ThreadPoolExecutor(1, "film-strips")  # OpenGL belongs to one thread
        self._lock = asyncio.Lock()

    def make_app(self) -> web.Application:
        """Return the application of aiohttp."""
        app = web.Application(middlewares=[self._check], client_max_size=4096)
        app.router.add_get("/", self._get_page)
        app.router.add_get("/episodes", self._get_episodes)
        app.router.add_get(r"/strips/{recording:\d{1,6}}/{episode:\d{1,6}}/{camera:\d{1,3}}", self._get_strip)
        app.router.add_post("/decide", self._decide)
        app.on_cleanup.append(self._close)
        return app

    async def _close(self, app: web.Application) -> None:
        self._artist.shutdown(wait=True, cancel_futures=True)

    @web.middleware
    async def _check(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse requests without the token; let nothing be kept or framed."""
        given = request.headers.get("X-Token") or request.query.get("token", "")
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self._token.encode()):
            return web.Response(status=403, text="wrong or no token: open the address that the command printed")
        response = await handler(request)
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response

    async def _get_page(self, request: web.Request) -> web.Response:
        nonce = secrets.token_urlsafe(12)
        page = Path(__file__).with_name("episodes_page.html")
        text = page.read_text(encoding="utf-8").replace("NONCE", nonce)
        headers = {"Content-Security-Policy": _POLICY.format(nonce)}
        return web.Response(text=text, content_type="text/html", headers=headers)

    async def _get_episodes(self, request: web.Request) -> web.Response:
        listed = await asyncio.to_thread(lambda: [attach_edits(one) for one in self._listed])
        cameras = [one.name for one in self._cameras] or [""]
        return web.json_response({"cameras": cameras, "recordings": [*map(_to_plain, listed)]})

    async def _get_strip(self, request: web.Request) -> web.StreamResponse:
        recording, episode, camera = (int(request.match_info[key]) for key in ("recording", "episode", "camera"))
        if recording >= len(self._listed):
            raise web.HTTPNotFound(text="there is no such recording")
        fault = await asyncio.get_running_loop().run_in_executor(self._artist, self._draw, recording)
        path = self._folder / f"{recording}-{episode}-{camera}.jpg"
        if fault or not path.is_file():
            raise web.HTTPNotFound(text=fault or "there is no picture of it")
        return web.FileResponse(path)

    def _draw(self, index: int) -> str:
        """Draw the strips of a recording unless they are there. Return why there are none."""
        if index not in self._drawn:
            listed, self._drawn[index] = self._listed[index], ""
            try:
                for i, camera, strip in draw_strips(
                    listed.path, [one.span_ns for one in listed.episodes], self._cameras
                ):
                    Image.fromarray(strip).save(self._folder / f"{index}-{i}-{camera}.jpg", quality=80)
            except (IrisError, OSError) as error:
                self._drawn[index] = " ".join(str(error).split())
        return self._drawn[index]

    async def _decide(self, request: web.Request) -> web.Response:
        try:
            wanted = msgspec.json.decode(await request.read(), type=ButtonPress)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise web.HTTPBadRequest(text=f"no decision: {error}") from error
        if not 0 <= wanted.recording < len(self._listed) or wanted.decision not in DECISIONS:
            raise web.HTTPBadRequest(text=f"no such recording, or none of {', '.join(DECISIONS)}")
        listed = self._listed[wanted.recording]
        try:
            async with self._lock:
                await asyncio.to_thread(write_decision, listed, wanted)
        except IrisError as error:
            raise web.HTTPConflict(text=str(error)) from error
        return web.json_response(_to_plain(await asyncio.to_thread(attach_edits, listed)))


def write_decision(listed: ListedRecording, wanted: ButtonPress) -> None:
    """Write what a button says. A verdict that is the recorded one is no decision. Raises `DatasetError`."""
    number = wanted.number
    if wanted.decision in (KEEP, DROP):
        edits = Edits(drop=(number,)) if wanted.decision == DROP else Edits(keep=(number,))
    else:
        recorded = [one.verdict for one in listed.episodes if one.number == number and one.is_editable]
        edits = Edits(label={number: "" if [wanted.decision] == recorded else wanted.decision})
    write_curation(listed.path, edit_curation(*read_lengths(listed), edits))


def _to_plain(listed: ListedRecording) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(listed)
    for row, one in zip(plain["episodes"], listed.episodes, strict=True):
        row["final_verdict"] = one.final_verdict
    return plain


def serve_page(listed: Sequence[ListedRecording], cameras: Sequence[CameraSpec], port: int, *, opens: bool) -> int:
    """Serve the page until Ctrl-C, and open it in a browser if `opens`. Return the exit status."""
    with tempfile.TemporaryDirectory(prefix="iris-session-") as folder, suppress(KeyboardInterrupt):
        asyncio.run(_serve(listed, cameras, port, Path(folder), opens=opens))
    return 1 if any(one.problems for one in listed) else 0


async def _serve(
    listed: Sequence[ListedRecording], cameras: Sequence[CameraSpec], port: int, folder: Path, *, opens: bool
) -> None:
    token = secrets.token_urlsafe(24)
    runner = web.AppRunner(EpisodesPage(listed, cameras, token, folder).make_app(), access_log=None)
    await runner.setup()
    try:
        try:
            site = web.TCPSite(runner, HOST, port)
            await site.start()
        except OSError as error:
            raise CommandError(f"port {port} cannot be opened: {error.strerror}: give another one") from error
        address = f"http://{HOST}:{runner.addresses[0][1]}/?token={token}"
        print(to_printable(f"episodes of {len(listed)} recordings: {address} (Ctrl-C ends it)"), flush=True)
        if opens:
            webbrowser.open(address)
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, ended.set)
        await ended.wait()
    finally:
        await runner.cleanup()
