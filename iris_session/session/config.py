"""`SessionConfig`: every setting of a session, the checks of what an owner passes, and the anchors file.

The anchors file says where sheets and other anchors are; `serve --anchors` and `anchors solve --out` share it. Its form
is that of `anchors.constellation`; checked here is what a session needs beyond it.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Any, Final, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import mujoco
import numpy as np

from anchors.constellation import Constellation, ConstellationError
from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3, quat_normalize
from iris_session.authority import AuthorityConfig
from iris_session.cloud.model_camera import parse_model_camera
from iris_session.control import ControlConfig
from iris_session.protocol.common import Pose
from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.protocol.server_messages import MAX_MARKS
from iris_session.protocol.specs import ObjectSpec, RobotSpec, TaskSpec
from iris_session.recording.budget import MIN_BUDGET_BYTES
from iris_session.rrd.assets import RECORD_ASSETS, SCENE
from iris_session.scene.mujoco_visuals import Shown, make_shown
from iris_session.session.errors import ConfigError, short_repr
from iris_session.session.robots import RobotChoice

#: A printed sheet lying at the near edge of the demo table; `T_world_anchor` of anchor id "table".
DEFAULT_ANCHORS: Final[Mapping[str, PoseTuple]] = MappingProxyType({"table": ((0.0, -0.45, 0.0), IDENTITY_QUAT)})
#: Edge of the code printed on it [m]: what `anchors print` prints by default.
DEFAULT_SHEET_M: Final = 0.15
#: Rates at which point clouds and pictures can be recorded.
MIN_CLOUDS_HZ: Final = 0.01
MAX_CLOUDS_HZ: Final = 60.0


@dataclass(frozen=True)
class SessionConfig:
    """Settings of one session. Every value has a default.

    Args:
        name: Name of the session, 1 to 48 letters, digits, `.`, `_` or `-`. Another session on the network with the
            same name makes it end in a number.
        host: Address to listen on. Everything but loopback is encrypted.
        interfaces: Names or addresses of the networks to listen on, instead of `host`.
        advertise: Address to announce to clients that reach the session by another machine (a forwarding router).
        beacon_port: UDP port of the beacons by which clients find the session; 0 for no beacons.
        control_port: TCP port of the control channel; 0 for any free one.
        state_port: TCP port of the state channel; 0 for any free one. Media and assets use ports near it.
        state_hz: Rate of the published state, 1 to 240 [Hz].
        record: True writes `sessions/<UTC stamp>-<name>/session.rrd` below the current folder, a path writes there,
            False records nothing.
        record_clouds_hz: Frames per second of each point cloud and picture that go into the recording, 0 to 60 [Hz];
            0: none.
        record_assets: What of the scenes goes into the recording, so that it can be shown where their files are not:
            `scene` is what a client at the best level of detail needs, `all` has all levels, `none` the hash only.
        record_budget_bytes: Bytes that the recording may have, at least 16,000,000; 0: as many as the disk. As they
            come to an end, raw samples, media and assets are left out first; then the recording ends, and the session
            goes on. A resumed session has the budget anew.
        anchors: `T_world_anchor` by anchor id, as `((x, y, z), (w, x, y, z))` [m].
        anchor_sizes: Edge of the printed sheets [m] that are to be checked for a misprint. The default sheet has 0.15.
        anchor_errors: Stated p95 of the position error of anchors [m], which clients show.
        anchor_marks: Positions `(x, y, z)` of marks that can be touched, by anchor id and id of the mark, in the frame
            of the anchor [m].
        curve: Encrypt on loopback too.
        curve_key: ZeroMQ certificate of the server, instead of the key in the user's home of keys.
        curve_clients: Folder of public certificates, instead of the user's allow-list.
        keyframe_s: Distance of keyframes in the recording, 0.5 to 60 [s].
        web: Serve the page for browsers, where the extra `web` is installed.
        web_port: TCP port of the page; `None`: that of the state plus 3, or any free one.
        web_cert: Certificate (PEM) for HTTPS, instead of the one in the user's home of keys.
        web_key: Its key (PEM).
        assets: Offer meshes and textures to clients: True keeps them in the user's cache, a path in that folder.
        cameras: Camera files, each with a process that publishes its point cloud; see `iris-session cloud example`.
        pictures: Cameras of a MuJoCo model whose pictures clients get (`client.camera`), `CAMERA[:WIDTHxHEIGHT][@HZ]`
            each, by default 320x240 at 30 Hz; drawn by one process of its own.
        plain_pictures: Draw them without shadows, reflections and smooth edges: many times as fast without a graphics
            card.
        groups: Groups of geoms of a MuJoCo model that clients show; `None` for those that its own viewer shows: 0, 1
            and 2, but not 0 where that has the collision shapes (robosuite).
        sites: Groups of its sites that clients show, True for all sites, False for none; `None` for those that MuJoCo's
            viewer shows, 0 to 2.
        adapt_media: Send fewer media to clients on slow links, so that their state stays fresh.
        realtime: `run()` asks for real-time priority, and continues without it when it is refused.
        resume: A recording of `run()`, or its folder, to continue. Scene, robots, name, authority and control come from
            it, and addresses, ports and keys unless they are given.
        task: The task whose episodes are recorded: a task file, beside which its progress is kept, or a `TaskSpec`.
            With `resume`, the file that the session had.
        authority: Rules of leases, samples, handovers and alignment.
        control: Limits and gains of robots that participants drive.

    Raises:
        ConfigError: A value cannot be used; one line says what would be right.
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
    record_clouds_hz: float = 2.0
    record_assets: str = SCENE
    record_budget_bytes: int = 0
    anchors: Mapping[str, PoseTuple] = field(default_factory=lambda: DEFAULT_ANCHORS)
    anchor_sizes: Mapping[str, float] = field(default_factory=dict)
    anchor_errors: Mapping[str, float] = field(default_factory=dict)
    anchor_marks: Mapping[str, Mapping[str, Vec3]] = field(default_factory=dict)
    curve: bool = False
    curve_key: str = ""
    curve_clients: str = ""
    keyframe_s: float = 5.0
    web: bool = True
    web_port: int | None = None
    web_cert: str = ""
    web_key: str = ""
    assets: bool | str | Path = True
    cameras: tuple[str | Path, ...] = ()
    pictures: tuple[str, ...] = ()
    plain_pictures: bool = False
    groups: tuple[int, ...] | None = None
    sites: bool | tuple[int, ...] | None = None
    adapt_media: bool = True
    realtime: bool = True
    resume: str | Path | None = None
    task: str | Path | TaskSpec | None = None
    authority: AuthorityConfig = field(default_factory=AuthorityConfig)
    control: ControlConfig = field(default_factory=ControlConfig)

    def __post_init__(self) -> None:
        check_types(self)
        check_anchors(self.anchors, self.anchor_sizes, self.anchor_marks)
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}", self.name):
            raise ConfigError(
                f"session name {self.name!r} cannot be used: 1 to 48 letters, digits, '.', '_' or '-', "
                "beginning with a letter or digit"
            )
        if not re.fullmatch(r"[A-Za-z0-9._:-]{0,64}", self.advertise):
            raise ConfigError(f"advertise {self.advertise!r} is not an address without port, for example 203.0.113.7")
        for label in ("control_port", "state_port", "beacon_port", "web_port"):
            port = getattr(self, label)
            if port is not None and not 0 <= port <= 65535:
                raise ConfigError(f"{label} {port} is not a port: 0 (any free one) to 65535")
        if bool(self.web_cert) != bool(self.web_key):
            raise ConfigError("web_cert and web_key belong together: give both, or none")
        if not 1.0 <= self.state_hz <= 240.0:
            raise ConfigError(f"state_hz {self.state_hz} is out of range: 1 to 240")
        if not 0.5 <= self.keyframe_s <= 60.0:
            raise ConfigError(f"keyframe_s {self.keyframe_s} is out of range: 0.5 to 60")
        if not (self.record_clouds_hz == 0.0 or MIN_CLOUDS_HZ <= self.record_clouds_hz <= MAX_CLOUDS_HZ):
            raise ConfigError(
                f"record_clouds_hz {self.record_clouds_hz} is out of range: {MIN_CLOUDS_HZ:g} to {MAX_CLOUDS_HZ:g}, "
                "or 0 to record no clouds and pictures"
            )
        try:
            make_shown(self.groups, self.sites)
            for text in self.pictures:
                parse_model_camera(text)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        if self.record_assets not in RECORD_ASSETS:
            raise ConfigError(f"record_assets {self.record_assets!r:.80} is none of {', '.join(RECORD_ASSETS)}")
        if self.record_budget_bytes and self.record_budget_bytes < MIN_BUDGET_BYTES:
            raise ConfigError(
                f"record_budget_bytes {self.record_budget_bytes} is too small: give {MIN_BUDGET_BYTES} or more, or 0 "
                "for no budget"
            )

    def anchor_poses(self) -> dict[str, Pose]:
        """Return `T_world_anchor` of each anchor."""
        return {name: Pose(p, quat_normalize(q)) for name, (p, q) in self.anchors.items()}

    def sheet_sizes(self) -> dict[str, float]:
        """Return the edge of each printed sheet whose size is known [m], including the default one."""
        known = dict.fromkeys(DEFAULT_ANCHORS, DEFAULT_SHEET_M) if self.anchors == DEFAULT_ANCHORS else {}
        return {**known, **{name: float(size) for name, size in self.anchor_sizes.items()}}

    def mark_positions(self) -> dict[str, dict[str, Vec3]]:
        """Return the positions of the marks of each anchor in its frame [m]."""
        return {
            name: {mark: (float(x), float(y), float(z)) for mark, (x, y, z) in marks.items()}
            for name, marks in self.anchor_marks.items()
        }

    def recording_path(self) -> Path | None:
        """Return the path of the recording, `None` for none. A default folder gets its name at each call."""
        if self.record is False:
            return None
        if self.record is True:
            stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S.%fZ")
            return Path("sessions") / f"{stamp}-{self.name}" / "session.rrd"
        return Path(self.record)


def choose_shown(config: SessionConfig, groups: object, sites: object) -> Shown:
    """Return what clients see of a model: as given, `None` for what the configuration says. Raises `ConfigError`."""
    try:
        given: Any = config.groups if groups is None else groups, config.sites if sites is None else sites
        return make_shown(*given)
    except ValueError as error:
        raise ConfigError(str(error)) from error


_Spec = TypeVar("_Spec", RobotSpec, ObjectSpec)
#: Error texts: what is expected as robots and objects.
_ROBOTS: Final = (
    "a list of RobotSpec or names of robots, the path of a robots file, 'auto' or 'none' is expected; without robots= "
    "they are found in the model"
)
_OBJECTS: Final = (
    'a list of ObjectSpec is expected, as [ObjectSpec(name="hammer", body="hammer")] of iris_session.protocol.specs; '
    "without objects= they are found in the model"
)
#: Quaternions in hand-written files have few digits.
UNIT_TOLERANCE: Final = 1e-3
#: Millimetres in a field of metres are a mistake, not a sheet.
SMALLEST_SHEET_M: Final = 0.01
LARGEST_SHEET_M: Final = 5.0
#: Timestep that `run()` accepts: below, no computer keeps up; above, samples could not be held for a tick.
SHORTEST_TICK_S: Final = 1e-5
LONGEST_TICK_S: Final = 0.1


def check_types(config: Any) -> None:
    """Check the fields of a `SessionConfig` against their annotations. Raises `ConfigError`."""
    hints = get_type_hints(type(config))
    for item in fields(config):
        value = getattr(config, item.name)
        if not _is_of_type(value, hints[item.name]):
            raise ConfigError(f"{item.name} must be {item.type}, not {type(value).__name__} {value!r:.60}")


def _is_of_type(value: object, hint: Any) -> bool:
    """Return whether a value fits an annotation. A bool is no number, and a whole number is a float."""
    if get_origin(hint) is UnionType:
        return any(_is_of_type(value, one) for one in get_args(hint))
    if get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(_is_of_type(one, get_args(hint)[0]) for one in value)
    kind = get_origin(hint) or hint
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (float, int) if kind is float else kind)


def check_anchors(anchors: Mapping[str, Any], sizes: Mapping[str, Any], marks: Mapping[str, Any]) -> None:
    """Check poses `((x, y, z), (w, x, y, z))`, sizes [m] and marks of anchors. Raises `ConfigError`."""
    for name, positions in marks.items():
        _check_marks(name, positions, anchors)
    for name, size in sizes.items():
        if name not in anchors:
            raise ConfigError(f"anchor_sizes: there is no anchor {name!r}: {', '.join(map(repr, anchors)) or 'none'}")
        number = isinstance(size, int | float) and not isinstance(size, bool)
        if not (number and SMALLEST_SHEET_M <= size <= LARGEST_SHEET_M):
            raise ConfigError(
                f"anchor_sizes: {name!r}: {size!r:.40} is not the edge of a printed sheet in metres, "
                f"{SMALLEST_SHEET_M:g} to {LARGEST_SHEET_M:g}"
            )
    for name, pose in anchors.items():
        where = f"anchor {name!r}: {pose!r:.80}"
        try:
            p, q = (tuple(float(v) for v in part) for part in pose)
        except (TypeError, ValueError):
            p, q = (), ()
        if not isinstance(name, str) or (len(p), len(q)) != (3, 4):
            raise ConfigError(
                f"{where} must be T_world_anchor as ((x, y, z), (w, x, y, z)), metres and unit quaternion"
            )
        if not all(map(math.isfinite, (*p, *q))):
            raise ConfigError(f"{where} holds a number that is not finite")
        if abs(math.hypot(*q) - 1.0) > UNIT_TOLERANCE:
            raise ConfigError(f"{where}: the quaternion (w, x, y, z) has length {math.hypot(*q):.3g}, it must be 1")


def _check_marks(name: str, positions: object, anchors: Mapping[str, Any]) -> None:
    """Check the marks of one anchor. Raises `ConfigError`."""
    where = f"anchor_marks: {name!r}"
    if name not in anchors:
        raise ConfigError(f"{where}: there is no such anchor: {', '.join(map(repr, anchors)) or 'none'}")
    if not isinstance(positions, Mapping) or len(positions) > MAX_MARKS:
        raise ConfigError(f"{where}: {positions!r:.60} must be at most {MAX_MARKS} positions by id of the mark")
    for mark, at in positions.items():
        try:
            p = tuple(float(v) for v in at)
        except (TypeError, ValueError):
            p = ()
        right = isinstance(mark, str) and 0 < len(mark) <= MAX_ID and len(p) == 3
        if not right or not all(abs(v) <= LARGEST_SHEET_M for v in p):
            raise ConfigError(
                f"{where}: mark {mark!r:.60} at {at!r:.60} must be (x, y, z) in metres in the frame of the anchor, at "
                f"most {LARGEST_SHEET_M:g} m from it"
            )


def check_timestep(model: mujoco.MjModel) -> None:
    """Check that `run()` can keep the timestep of a model; a user loop may have any. Raises `ConfigError`."""
    timestep = float(model.opt.timestep)
    if not SHORTEST_TICK_S <= timestep <= LONGEST_TICK_S:
        raise ConfigError(
            f"the model has a timestep of {timestep:g} s, run() takes {SHORTEST_TICK_S:g} to {LONGEST_TICK_S:g} s: "
            '<option timestep="0.002"/>'
        )


def check_robots(robots: object) -> RobotChoice:
    """Return names or specifications as a tuple, anything else that `choose_robots` takes as it is.

    Raises `ConfigError`.
    """
    if robots is None or isinstance(robots, str | Path):
        return robots
    if isinstance(robots, Iterable) and not isinstance(robots, bytes | Mapping):
        robots = tuple(robots)
        if robots and all(isinstance(one, str) for one in robots):
            return robots
    return _check_specs("robots", robots, RobotSpec, _ROBOTS)


def check_objects(objects: object) -> tuple[ObjectSpec, ...] | None:
    """Return the specifications as a tuple, `None` to find them in the model. Raises `ConfigError`."""
    return None if objects is None else _check_specs("objects", objects, ObjectSpec, _OBJECTS)


def _check_specs(what: str, given: object, kind: type[_Spec], expected: str) -> tuple[_Spec, ...]:
    if isinstance(given, str | bytes | Path | Mapping) or not isinstance(given, Iterable):
        raise ConfigError(f"{what} is {short_repr(given)}: {expected}")
    specs = tuple(given)
    for place, spec in enumerate(specs):
        if not isinstance(spec, kind):
            raise ConfigError(f"{what}[{place}] is {short_repr(spec)}: {expected}")
        try:
            msgspec.msgpack.decode(msgspec.msgpack.encode(spec), type=kind)
        except (TypeError, ValueError) as error:  # as the journal could not hold it
            raise ConfigError(f"{what}[{place}] is a {kind.__name__} with a wrong field: {error}") from error
    return specs


def check_arguments(model: object, data: object, config: object) -> None:
    """Check model, data and configuration. Raises `TypeError`, and `ConfigError` for data of another model."""
    if type(config).__name__ != "SessionConfig":
        raise TypeError(f"config must be a SessionConfig, not {type(config).__name__}: Session(model, data, config)")
    if not isinstance(model, mujoco.MjModel):
        kind = type(model).__name__
        advice = "; call its compile() first" if kind == "MjSpec" else ""
        raise TypeError(f"model must be an MjModel or the path of a model file, not {kind}{advice}")
    if data is None:
        return
    if not isinstance(data, mujoco.MjData):
        raise TypeError(f"data must be MjData of the model, not {type(data).__name__}: Session(model, data, config)")
    if np.shape(data.qpos) != (model.nq,) or np.shape(data.ctrl) != (model.nu,):
        raise ConfigError(
            f"data is of another model: it has {np.size(data.qpos)} positions and {np.size(data.ctrl)} controls, "
            f"the model {model.nq} and {model.nu}"
        )


HELP: Final = "`iris-session anchors example` prints one that is right"
#: Characters of a name on the wire.
MAX_ID: Final = 64
#: An anchor further away is in millimetres.
MAX_DISTANCE_M: Final = 100.0


def load_anchors(path: Path) -> Constellation:
    """Read an anchors file.

    Raises:
        ConfigError: The file cannot be read or used; one line says what would be right.
    """
    try:
        text = path.expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ConfigError(f"anchors file {str(path)!r} cannot be read: {why}; {HELP}") from error
    try:
        found = Constellation.from_toml(text)
    except ConstellationError as error:
        raise ConfigError(f"{path.name}: {' '.join(str(error).split())}; {HELP}") from error
    for name, (p, _) in found.anchors.items():
        if not 0 < len(name) <= MAX_ID:
            raise ConfigError(f"{path.name}: {name[:80]!r} cannot be the id of an anchor: 1 to {MAX_ID} characters")
        if max(map(abs, p)) > MAX_DISTANCE_M:
            raise ConfigError(
                f"{path.name}: anchors.{name}.position_m is {max(map(abs, p)):g} m away: are these metres?"
            )
    try:
        check_anchors(found.anchors, found.sizes, found.marks)
    except ConfigError as error:
        raise ConfigError(f"{path.name}: {error}") from error
    return found


def dump_anchors(
    anchors: Mapping[str, PoseTuple],
    sizes: Mapping[str, float],
    marks: Mapping[str, Mapping[str, Vec3]] = MappingProxyType({}),
) -> str:
    """Return the text of an anchors file, to be edited; `load_anchors` reads it back."""
    reference = next(iter(anchors))
    head = (
        "# Where anchors are: T_world_anchor, metres and a unit quaternion, w first. The origin of a sheet is the\n"
        "# centre of its code, x right, y up along the upright sheet, z out of the paper. `size_m`: edge of the code\n"
        "# as measured; leave it out where not known. `error_m`: 95 % of how well the place is known relative to\n"
        "# the reference. `marks_m`: crosses to be touched (`anchors print --marks`), by id, in the sheet frame.\n"
    )
    errors = dict.fromkeys(anchors, 0.0)
    touched = {name: dict(positions) for name, positions in marks.items()}
    return head + Constellation(reference, dict(anchors), errors, dict(sizes), touched).to_toml()
