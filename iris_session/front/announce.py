"""What a session makes known of itself: the beacon and the introduction, put together from the front's parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iris_session.front.beacon import BeaconSender
from iris_session.front.introduction import IntroductionServer, Listeners
from iris_session.front.service import Service
from iris_session.link.config import FrontConfig, Ports
from iris_session.link.interfaces import WILDCARDS, interfaces, public_host, reachable
from iris_session.link.sockets import host_in_address
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import PROTOCOL_VERSION


class SessionFacts(NamedTuple):
    """What the introduction tells beside the beacon, as it is now. `server_key`: Z85, empty without encryption."""

    server_key: str
    pairing: Callable[[], bool]
    participants: Callable[[], int]


def choose_address_host(config: FrontConfig) -> str:
    """What stands before `:PORT` in our address: an address of this machine, IPv6 in brackets."""
    host = config.hosts[0]
    return host_in_address(public_host(config.hosts, interfaces()) if host in WILDCARDS else host)


def list_reachable_hosts(config: FrontConfig) -> tuple[str, ...]:
    """The addresses under which others reach the session, best first; `advertise` before all others."""
    have = interfaces()
    covered = [one.address for one in reachable(config.hosts, have) if config.loopback or not one.loopback]
    told = [config.advertise, *covered] if config.advertise else covered
    return tuple(dict.fromkeys(told)) or config.hosts


def make_discovery_services(
    config: FrontConfig, ports: Ports, listeners: Listeners, drops: Drops, facts: SessionFacts
) -> list[Service]:
    """The services that make this session known."""
    beacon = Beacon(
        protocol=PROTOCOL_VERSION,
        session_id=config.session_id,
        session_name=config.session_name,
        kind=config.session_kind,
        host=ports.reachable[0],
        control=ports.control,
        state=ports.state,
        media=ports.media,
        assets=ports.assets,
        web=config.web_port,
        key_fingerprint=ports.key_fingerprint,
    )

    def introduction() -> Introduction:
        return Introduction(beacon, facts.server_key, facts.pairing(), facts.participants())

    services: list[Service] = [IntroductionServer(listeners, introduction)]
    if config.beacon_port:
        services.append(BeaconSender(beacon, config.hosts, config.beacon_port, drops, config.advertise))
    return services
