"""The gateway's side of its session: what waits while the session does not read."""

from __future__ import annotations

import asyncio

import msgspec
import zmq

from iris_session.protocol.client_messages import EStop, wrap_message
from iris_session.protocol.codec import decode_client, encode_client
from iris_session.web import session_link
from iris_session.web.config import GatewayConfig
from iris_session.web.hub import Hub
from iris_session.web.session_link import SessionLink


def test_an_estop_overtakes_all_that_a_session_has_not_read() -> None:
    """A session that reads nothing, then all: few messages are ahead of the stop, and no tick is needed to send it."""

    async def send() -> tuple[int, int]:
        with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
            router.linger = 0
            router.rcvhwm, router.rcvbuf = 1, 4096
            hub = Hub()
            loud, ann = (hub.open_browser(bytes((n,)) * 6, "10.0.0.1", 0) for n in range(2))
            assert loud is not None
            assert ann is not None
            ann.epoch = 5
            link = SessionLink(GatewayConfig(control_port=router.bind_to_random_port("tcp://127.0.0.1")), hub)
            link.open()
            while not router.poll(0):  # its hello: it is connected
                link.tick()
                await asyncio.sleep(0)
            link._ready.set()
            large = msgspec.msgpack.encode([1, 5, loud.name, {"type": "samples", "samples": [], "pad": bytes(4000)}])
            n_sent = 0
            while len(link._uplink) < 300:
                assert link.send(loud, large) is None
                n_sent += 1
                await asyncio.sleep(0)
            assert link.send(ann, encode_client(wrap_message(EStop(), 5, ann.name))) is None
            n_ahead = 0
            router.recv_multipart()
            while True:
                while not router.poll(0):
                    await asyncio.sleep(0)
                data = router.recv_multipart()[1]
                if len(data) < 4000 and isinstance(decode_client(data).message, EStop):
                    break
                n_ahead += 1
            link.close()
            return n_sent, n_ahead

    n_sent, n_ahead = asyncio.run(send())
    assert n_ahead <= n_sent - 290
    assert session_link.CONTROL_SEND_HWM < 100
