"""The web gateway of a served session: browsers join, watch, fetch, come back; hostile ones disturb no one."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any

import psutil
import pytest

from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Acquire, Hello, Pair
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused, Reply
from iris_session.protocol.status import GetStatus, StatusReport
from tests.e2e.session_process import COMMAND, DEADLINE_S, END_WITH_PARENT, SessionProcess, run_command, wait_until
from tests.web.browser import WebBrowser, open_http

pytestmark = pytest.mark.e2e
Serve = Callable[..., SessionProcess]


def page_of(server: SessionProcess) -> str:
    wait_until(lambda: "in a browser: " in server.output, "the page's address")
    found = re.search(r"in a browser: (\S+)", server.output)
    assert found, server.output
    return found[1]


def run(work: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(work, 2 * DEADLINE_S))


@contextlib.asynccontextmanager
async def browsers(page: str, *names: str) -> AsyncIterator[list[WebBrowser]]:
    """Browsers that have joined as observers."""
    async with open_http() as http:
        made = [WebBrowser(http, page, name) for name in names]
        try:
            for one in made:
                await one.join()
            yield made
        finally:
            for one in made:
                await one.close()


@pytest.fixture(scope="module")
def page(shared_session: SessionProcess) -> str:
    return page_of(shared_session)


@pytest.mark.long
def test_assets_are_fetched_with_ranges_and_a_ticket(page: str) -> None:
    async def work() -> None:
        async with browsers(page, "ann", "bob") as (ann, bob):
            address = (await ann.snapshot()).scene_hash
            answers = await asyncio.gather(*(one.fetch(address) for one in (ann, bob, ann, bob)))
            for status, body, headers in answers:
                assert status == 200
                assert hashlib.sha256(body).hexdigest() == address
                assert headers["Cache-Control"] == "private, immutable, max-age=31536000"
            body, total = answers[0][1], len(answers[0][1])
            for given, begin, end in (("0-0", 0, 1), ("5-9", 5, 10), ("10-", 10, total), ("-7", total - 7, total)):
                status, part, headers = await ann.fetch(address, Range=f"bytes={given}")
                assert (status, part) == (206, body[begin:end])
                assert headers["Content-Range"] == f"bytes {begin}-{end - 1}/{total}"
            status, _, headers = await ann.fetch(address, Range=f"bytes={total}-")
            assert (status, headers["Content-Range"]) == (416, f"bytes */{total}")
            for address_given, ticket, expected in (
                (address, "", 401),
                (address, "x" * 4000, 401),
                ("0" * 64, None, 404),
                (address.upper(), None, 404),
                ("%2e%2e", None, 404),
            ):
                assert (await ann.fetch(address_given, ticket))[0] == expected
            ticket = bob.ticket
            await bob.close()
            await asyncio.sleep(0.3)
            assert (await ann.fetch(address, ticket))[0] == 401, "the ticket of a browser that has closed"

    run(work())


def test_killed_gateway_comes_back_and_leases_stay(serve: Serve) -> None:
    server = serve()
    page = page_of(server)

    async def work() -> None:
        async with open_http() as http:
            ann = await WebBrowser(http, page, "ann").join("operator")
            await ann.send(Acquire(1, ("left",)))
            assert (await ann.wait_for(Reply)).denial is None
            participant = ann.welcome.participant_id  # type: ignore[union-attr]
            for name in ("web.gateway", "front.main"):
                if name == "front.main":
                    await asyncio.sleep(1.5)
                server.children()[name].kill()
                await ann.wait(lambda: ann.socket.closed, f"{name} is noticed")
                begin = time.monotonic()
                welcome = await ann.come_back("operator")
                assert welcome.resumed, name
                assert welcome.participant_id == participant
                snapshot = await ann.snapshot()
                assert {lease.target: lease.holder for lease in snapshot.leases}["left"] == participant
                print(f"{name}: back after {time.monotonic() - begin:.2f} s")
            await ann.close()

    run(work())
    assert "web gateway ended" in server.output


def test_a_browser_pairs_by_the_printed_link_and_is_revoked(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "keys"))
    page = page_of(serve("handover", "--curve"))
    made = run_command("pair", "--web", "--no-wait", "--json", "--role", "observer", cwd=tmp_path)
    invitation = json.loads(made.stdout)
    assert invitation["page"] == f"{page}#c={invitation['code']}"
    secret = bytes(range(32))
    identity = hashlib.sha256(secret).digest()

    async def work() -> None:
        async with open_http() as http:
            async with http.get(f"{page}v1/info") as answer:
                info = await answer.json()
            assert info["pairing"] is True
            key = base64.urlsafe_b64decode(info["key"] + "=")
            async with http.get(page.replace("https://", "http://"), allow_redirects=False) as answer:
                assert (answer.status, answer.headers["Location"]) == (307, page)
            stretched = pairing.stretch_code(invitation["code"], key)
            proof = pairing.make_client_proof(stretched, key, identity)
            ann = await WebBrowser(http, page, "ann", secret).open()
            await ann.send(Hello("observer", "ann", secret=secret), 0)
            assert (await ann.wait_for(Refused)).code == "unpaired"
            await ann.send(Pair("ann's tab", proof, identity=identity), 0)
            paired = await ann.wait_for(Paired)
            assert pairing.is_same_proof(paired.proof, pairing.make_server_proof(stretched, key, identity))
            assert paired.roles == ("observer",)
            await ann.close()
            await ann.join()
            await ann.wait(lambda: len(ann.states) > 5, "state")
            status, _, _ = await ann.fetch((await ann.snapshot()).scene_hash)
            assert status == 200
            listed = json.loads((await asyncio.to_thread(run_command, "keys", "list", "--json", cwd=tmp_path)).stdout)
            assert [one["name"] for one in listed["keys"]] == ["ann's tab"]
            await asyncio.to_thread(run_command, "keys", "revoke", "ann's tab", cwd=tmp_path)
            await ann.wait(lambda: any(f.code == "revoked" for f in ann.got(ProtocolFault)), "revoked")
            n = len(ann.states)
            await asyncio.sleep(0.5)
            assert len(ann.states) == n, "no state any more"
            assert (await ann.fetch("0" * 64))[0] == 401
            await ann.close()

    run(work())


@pytest.mark.long
def test_a_gateway_by_hand_fetches_an_asset_once_for_all(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serve("handover", "--no-web")
    assert "in a browser" not in server.output
    listening = [c for c in psutil.Process(server.process.pid).net_connections("tcp") if c.status == "LISTEN"]
    assert listening == []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    out = (tmp_path / "web.out").open("w+b")
    command = [*COMMAND, "web", server.address, "--web-port", str(port)]
    refused = run_command(*command[len(COMMAND) :], "--host", "0.0.0.0", cwd=tmp_path)
    assert refused.returncode == 2, "a session without keys admits everybody"
    assert "--curve" in refused.stderr
    gateway = subprocess.Popen([*END_WITH_PARENT, *command], stdout=out, stderr=subprocess.STDOUT)
    page = f"http://127.0.0.1:{port}/"

    def can_connect() -> bool:
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return True
        return False

    async def work() -> None:
        async with browsers(page, "ann", "bob") as (ann, bob):
            address = (await ann.snapshot()).scene_hash
            answers = await asyncio.gather(*(one.fetch(address) for one in (ann, bob) * 8))
            assert {status for status, _, _ in answers} == {200}
            assert {hashlib.sha256(body).hexdigest() for _, body, _ in answers} == {address}
            await ann.send(GetStatus())
            report = await ann.wait_for(StatusReport)
            size = len(answers[0][1])
            assert size <= report.assets.bytes_sent <= size + 10, "its bytes once, and one byte to ask for its size"

    try:
        wait_until(can_connect, "the gateway listens")
        run(work())
        gateway.send_signal(signal.SIGINT)
        assert gateway.wait(DEADLINE_S) == 0
        out.seek(0)
        assert out.read().decode().splitlines() == [f"in a browser: {page}"]
    finally:
        gateway.kill()
        gateway.wait()
        out.close()
