"""Impairment proxies in front of a running session: clients join at the loopback address of a link."""

from __future__ import annotations

from collections.abc import Mapping

from iris_session.netsim.process import ImpairmentProcess
from iris_session.session.session import Session


def make_link_address(number: int) -> str:
    """Return the loopback address of link `number` (0 to 253): one per headset, as each has its own wireless link."""
    return f"127.0.1.{number + 1}"


def start_links(session: Session, links: Mapping[str, str], seed: int = 0) -> ImpairmentProcess:
    """Start the proxy for the ports of a running session, as a context. `links`: profile by loopback address.

    Raises `ImpairmentError` when an address or port is in use.
    """
    front = session.processes.front
    assert front is not None
    assert front.link.ports is not None
    ports = front.link.ports
    return ImpairmentProcess(links, [ports.control, ports.state, ports.media], target=ports.host, seed=seed)


def get_address_over(session: Session, link: str) -> str:
    """Return the address at which a client joins over `link`."""
    return f"{link}:{session.address.rpartition(':')[2]}"
