"""Sockets of the gateway to its session."""

from __future__ import annotations

import asyncio

from iris_session.protocol.limits import Drops
from iris_session.web.config import GatewayConfig
from iris_session.web.hub import Hub, HubLimits
from iris_session.web.session_link import SessionLink


def test_media_do_not_share_the_io_thread_of_state() -> None:
    async def act() -> None:
        hub = Hub(HubLimits(), Drops())
        link = SessionLink(GatewayConfig(control_port=1), hub)
        link.open()
        browser = hub.open_browser(bytes(6), "127.0.0.1", 0)
        assert browser is not None
        media = link.open_media(browser, lambda _frames: None)
        assert link._control is not None
        assert media._reader.socket.context is not link._control.socket.context
        media.close()
        link.close()
        assert media._reader.socket.context.closed

    asyncio.run(act())
