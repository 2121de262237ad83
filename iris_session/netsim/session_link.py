"""Bad links in front of a running session, for demos and benchmarks: clients join at the address of a link."""

from __future__ import annotations

from collections.abc import Mapping

from iris_session.netsim.process import ImpairmentProcess
from iris_session.session.session import Session


def link_address(number: int) -> str:
    """Address of link `number` (0 to 253): one per headset, since each has a radio link of its own."""
    return f"127.0.1.{number + 1}"


def links_before(session: Session, links: Mapping[str, str], seed: int = 0) -> ImpairmentProcess:
    """The proxy, as a context: `links` is profile by loopback address; ports are those of `session`, which runs.

    Raises `ImpairmentError` when an address or port is in use.
    """
    front = session.processes.front
    assert front is not None
    assert front.link.ports is not None
    ports = front.link.ports
    return ImpairmentProcess(links, [ports.control, ports.state, ports.media], target=ports.host, seed=seed)


def address_over(session: Session, link: str) -> str:
    """Where a client joins over `link`."""
    return f"{link}:{session.address.rpartition(':')[2]}"
