"""`SessionConfig`: every setting of a session, each with a default that works. Nothing here is required."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Final

from anchors.pose import IDENTITY_QUAT, PoseTuple, quat_normalize
from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.protocol.common import Pose
from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.session.config_checks import check_anchors, check_types
from iris_session.session.errors import ConfigError

#: A printed sheet lying at the near edge of the demo table; `T_world_anchor` of anchor id "table".
DEFAULT_ANCHORS: Final[Mapping[str, PoseTuple]] = MappingProxyType({"table": ((0.0, -0.45, 0.0), IDENTITY_QUAT)})
#: Edge of the code printed on it [m].
DEFAULT_SHEET_M: Final = 0.16


@dataclass(frozen=True)
class SessionConfig:
    """Settings of one session.

    `record`: True writes `sessions/<UTC stamp>-<name>/session.rrd` below the current folder, a path writes there,
    False records nothing. Port 0 takes any free one. `interfaces`: names or addresses of the networks to listen on,
    instead of `host`; `advertise`: the address that others are told when it is none of ours (a forwarding router).
    `beacon_port`: UDP port on which the session tells of itself, 0 for not at all. `anchors`: `T_world_anchor` per
    anchor id; `anchor_sizes`: edge of the printed sheets [m], of those that are to be checked for a misprint (the
    default one: 0.16). Off loopback everything is encrypted, with `curve` on loopback too: with the key and the
    allow-list of the user's home of keys, or with the ZeroMQ certificate `curve_key` and the folder of certificates
    `curve_clients`.
    `assets`: meshes and textures for clients, kept in the user's cache of assets or in that folder; False: none.
    `sites`, `tendons`: clients are told of those of a MuJoCo model too (tendons bring the sites they run through).
    `adapt_media`: clients on slow links get fewer media streams, so that their state stays fresh.
    `keyframe_s`: distance of the recording's keyframes [s]. `realtime`: `run()` asks for a real-time priority and goes
    on without when refused. `resume`: a recording (or its folder) of our loop to go on from; scene, robots, name,
    authority and control come with it, and what is left at its default here is as it was: addresses, ports, keys.
    """

    name: str = "session"
    host: str = "127.0.0.1"
    interfaces: tuple[str, ...] = ()
    advertise: str = ""
    beacon_port: int = DISCOVERY_PORT
    control_port: int = 7721
    state_port: int = 7722
    state_hz: float = 60.0
    record: bool | str | Path = True
    anchors: Mapping[str, PoseTuple] = field(default_factory=lambda: DEFAULT_ANCHORS)
    anchor_sizes: Mapping[str, float] = field(default_factory=dict)
    curve: bool = False
    curve_key: str = ""
    curve_clients: str = ""
    keyframe_s: float = 5.0
    assets: bool | str | Path = True
    sites: bool = False
    tendons: bool = False
    adapt_media: bool = True
    realtime: bool = True
    resume: str | Path | None = None
    authority: AuthorityConfig = field(default_factory=AuthorityConfig)
    control: ControlConfig = field(default_factory=ControlConfig)

    def __post_init__(self) -> None:
        check_types(self)
        check_anchors(self.anchors, self.anchor_sizes)
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}", self.name):
            raise ConfigError(
                f"session name {self.name!r} cannot be used: 1 to 48 letters, digits, '.', '_' or '-', "
                "beginning with a letter or digit"
            )
        if not re.fullmatch(r"[A-Za-z0-9._:-]{0,64}", self.advertise):
            raise ConfigError(f"advertise {self.advertise!r} is not an address without port, for example 203.0.113.7")
        for label in ("control_port", "state_port", "beacon_port"):
            port = getattr(self, label)
            if not 0 <= port <= 65535:
                raise ConfigError(f"{label} {port} is not a port: 0 (any free one) to 65535")
        if not 1.0 <= self.state_hz <= 240.0:
            raise ConfigError(f"state_hz {self.state_hz} is out of range: 1 to 240")
        if not 0.5 <= self.keyframe_s <= 60.0:
            raise ConfigError(f"keyframe_s {self.keyframe_s} is out of range: 0.5 to 60")

    def anchor_poses(self) -> dict[str, Pose]:
        """`T_world_anchor` of each anchor, as it travels."""
        return {name: Pose(p, quat_normalize(q)) for name, (p, q) in self.anchors.items()}

    def sheet_sizes(self) -> dict[str, float]:
        """Edge of each printed sheet [m] whose size is known, the default one's included."""
        known = dict.fromkeys(DEFAULT_ANCHORS, DEFAULT_SHEET_M) if self.anchors == DEFAULT_ANCHORS else {}
        return {**known, **{name: float(size) for name, size in self.anchor_sizes.items()}}

    def recording_path(self) -> Path | None:
        """Where this session records to, None when it does not. The name of a default folder is made at each call."""
        if self.record is False:
            return None
        if self.record is True:
            stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S.%fZ")
            return Path("sessions") / f"{stamp}-{self.name}" / "session.rrd"
        return Path(self.record)
