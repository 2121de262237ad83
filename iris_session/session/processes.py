"""The processes of a session besides the authority: front, recorder, web gateway, cameras; start, supervise, end.

A front that dies is replaced on the same ports (clients reconnect and resume); a recorder that dies is replaced and
continues in a new part of the recording; the web gateway is started with the first connection of a browser, and again
when it dies; camera processes are started with the session, and again when they die. All of it is announced and logged,
and stops no step. A process that dies again and again is restarted after growing delays.
"""

from __future__ import annotations

import datetime
import importlib.util
import logging
import secrets
import time
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from iris_session.journal.environment import describe_environment, read_boot_id
from iris_session.journal.feed import SILENCE_S
from iris_session.link import FrontConfig, FrontError, FrontProcess, Ports, addresses_of
from iris_session.link.sockets import host_in_address
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import StatusReport
from iris_session.recording import (
    CLOSED,
    OPEN,
    RecorderFeed,
    RecorderProcess,
    RecordingError,
    RecordingLock,
    SessionHeader,
    Settings,
    header_root,
    pack_model,
)
from iris_session.recording.folders import check_new_recording
from iris_session.scene.mujoco_visuals import Shown
from iris_session.scene.result import ComposedScene
from iris_session.session.cameras import SessionCameras
from iris_session.session.config import SessionConfig
from iris_session.session.core import SessionCore
from iris_session.session.deformables import DeformableSourceMesh, DeformableStreams, list_deformables
from iris_session.session.errors import StartError
from iris_session.session.resume import (
    Listening,
    PastSession,
    ResumeNote,
    ResumeNoteWriter,
    find_note_path,
    wait_for_free_ports,
)
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.status import StatusReporter, make_recorder_report
from iris_session.session.stepper import NextPatch, NextScene, PendingInputs, ResumedFrom, Stepper, label_robots
from iris_session.session.unique_name import NameFinder
from iris_session.session.web_page import WebPage, open_web_page

#: Ports of media and assets, from the port of state: 7723, 7726 and 7724 by default.
MEDIA_OFFSET: Final = 1
INGEST_OFFSET: Final = 4
ASSETS_OFFSET: Final = 2
SUPERVISE_PERIOD_NS: Final = 50_000_000
#: Longest time for the recorder to accept the last rows; for one that was just started. Busy machines are slow: one
#: that does not work at all has `SILENCE_S`, or `STARTING_S` until it is up.
ACCEPT_S: Final = 30.0
START_S: Final = 60.0
STARTING_S: Final = 15.0
#: Time for the front to notify its clients, for the recorder to finish its file, for one that did not accept its rows.
NOTIFY_S: Final = 0.6
FINISH_S: Final = 10.0
HANGING_EXIT_S: Final = 0.2

_log = logging.getLogger(__name__)


class PublishedScene(NamedTuple):
    """A scene whose world MuJoCo does not simulate: its specification for clients, and its deformables."""

    scene: ComposedScene
    deformables: tuple[DeformableSourceMesh, ...]


class SessionProcesses:
    """Front, recorder, web gateway and camera processes of one session.

    Args:
        config, past: As of the session; `past` is the one that is resumed.
        core: The session's core, in the state that clients see first.
        origin_ns: `time.monotonic_ns()` at session time 0.
        published: The scene of `core` where it cannot be read off its model.

    Attributes:
        address: `host:port` of the control channel; it stays the same when the front is replaced.
        name: Name of the session; with a number where another session on the network has the configured one.
        notes: Messages for people about how the session started, one line each.
    """

    def __init__(
        self,
        config: SessionConfig,
        core: SessionCore,
        origin_ns: int,
        past: PastSession | None = None,
        published: PublishedScene | None = None,
    ) -> None:
        self._config = config
        self._origin_ns = origin_ns
        self._past = past
        self.session_id = secrets.token_hex(8) if past is None else past.header.session_id
        self.name = config.name
        self.notes: list[str] = []
        self.recording = config.recording_path() if past is None else past.recording
        self._in_use: RecordingLock | None = None
        self._note_writer: ResumeNoteWriter | None = None
        self._core = core
        self._published = published
        scene = None if published is None else published.scene
        self.scenes = SharedScenes(config.assets, config.name, scene, Shown(config.groups, config.sites))
        self.state_period_ns = round(1e9 / config.state_hz)
        self.recorder: RecorderProcess | None = None
        self.feed: RecorderFeed | None = None
        self.front: FrontProcess | None = None
        self.web: WebPage | None = None
        self.cameras: SessionCameras | None = None
        self._deformables: DeformableStreams | None = None
        self.reporter = StatusReporter()
        self._next_supervise_ns = 0
        self.address = ""
        self._overflows: dict[str, int] = {}  # contacts that MuJoCo had no room for
        self._world_overflows: dict[str, int] = {}  # the same since the world was reset
        self._dropped: set[str] = set()  # reasons that were logged

    def start(self) -> None:
        """Start the recorder, then the front; end both again when one fails.

        Raises:
            StartError: A process did not come up; one line says why.
        """
        if self.recording is not None and importlib.util.find_spec("rerun") is None:
            raise StartError(
                "recording needs rerun: pip install 'iris-session[recording]', or record nothing (--no-record, "
                "SessionConfig(record=False))"
            )
        # The model of a published world has its bodies, and nothing to be drawn.
        self.cameras = SessionCameras(self._config, None if self._published else self._core.world.model)
        others = NameFinder(self._config.beacon_port)
        try:
            if self.recording is not None:
                if self._past is None:
                    check_new_recording(self.recording)
                self.recorder = RecorderProcess(
                    self.recording,
                    self._origin_ns,
                    record_assets=self._config.record_assets,
                    budget_bytes=self._config.record_budget_bytes,
                )
                self.recorder.start()
                self.reporter.warning_sources.append(self.recorder.list_warnings)
                self.feed = RecorderFeed(self.recorder.feed_endpoint)
                self._in_use = RecordingLock(self.recording, shared=True)
                if not self._core.config.authority.user_owned_loop:  # others cannot be resumed
                    self._note_writer = ResumeNoteWriter(find_note_path(self.recording))
            self.name = others.find_free_name(self._config.name, self.session_id)
            self.notes += others.notes
            self.web = open_web_page(self._config, self.name)
            self.front = FrontProcess(
                self._make_front_config(),
                self.scenes.show(
                    self.scenes.make(self._core.world, self._core.scene.initial_state, self._core.authority.patches)
                ),
            )
            if self._past is not None:
                self.notes += self._past.notes
                self.front.link.handback = self._past.handback
                wait_for_free_ports(self._config)
            ports = self.front.start()
            self._save_resume_note()
            self.address = f"{ports.host}:{ports.control}"
            reachable = [f"{host_in_address(host)}:{ports.control}" for host in ports.reachable]
            if ports.key_fingerprint:
                how = "keys in that folder join" if self._config.curve_clients else "new devices: `iris-session pair`"
                self.notes.append(f"encrypted, key {ports.key_fingerprint}; {how}")
            if reachable != [self.address]:
                self.notes.append(f"others reach it at {', '.join(reachable)}")
            self.notes += self.web.start(ports, self.scenes.asset_root)
            self.notes += self.cameras.start(ports)
            self.reporter.warning_sources += [self.cameras.list_warnings, lambda: self.scenes.advice]
            _log.info("session %r on %s, recording: %s", self.name, self.address, self.recording or "none")
        except (FrontError, RecordingError) as error:
            self.close()
            raise StartError(str(error)) from None  # the text says it all
        except BaseException:
            self.close()
            raise
        finally:
            others.close()

    def _save_resume_note(self) -> None:
        """Queue for the disk the data that resuming needs and the journal lacks: the front's state and its ports."""
        if self._note_writer is None or self.front is None or self.front.link.ports is None:
            return
        ports = self.front.link.ports
        given = {name: getattr(self._config, name) for name in Listening.__struct_fields__}
        listening = Listening(**given | {"control_port": ports.control, "state_port": ports.state})
        self._note_writer.offer(ResumeNote(self.session_id, listening, self.front.link.handback))

    def _make_front_config(self) -> FrontConfig:
        config, web, task = self._config, self.web, self._core.config.authority.task
        return FrontConfig(
            host=config.host,
            listen=addresses_of(config.interfaces) if config.interfaces else (),
            advertise=config.advertise,
            beacon_port=config.beacon_port,
            control_port=config.control_port,
            state_port=config.state_port,
            media_port=config.state_port + MEDIA_OFFSET if config.state_port else 0,
            media_ingest_port=config.state_port + INGEST_OFFSET if config.state_port else 0,
            assets_port=config.state_port + ASSETS_OFFSET if config.state_port else 0,
            web_port=0 if web is None else web.port,
            gateway_key="" if web is None else web.public_key,
            camera_keys=() if self.cameras is None else self.cameras.public_keys,
            adapt_media=config.adapt_media,
            session_id=self.session_id,
            session_name=self.name,
            task_robots=() if task is None else task.robots[:32],
            origin_ns=self._origin_ns,
            state_period_ns=self.state_period_ns,
            curve=config.curve,
            curve_secret_file=config.curve_key,
            curve_clients_dir=config.curve_clients,
            anchors=config.anchor_poses(),
            anchor_sizes=config.sheet_sizes(),
            anchor_errors={name: float(error_m) for name, error_m in config.anchor_errors.items()},
            anchor_marks=config.mark_positions(),
            recorder_endpoint="" if self.recorder is None else self.recorder.samples_endpoint,
            recorder_media_endpoint="" if self.recorder is None else self.recorder.media_endpoint,
            record_clouds_hz=config.record_clouds_hz,
        )

    @property
    def front_ports(self) -> Ports:
        """Ports of the front. The session must be started."""
        assert self.front is not None
        assert self.front.link.ports is not None
        return self.front.link.ports

    def make_stepper(
        self, core: SessionCore, clock: Callable[[], int], inputs: PendingInputs, *, user_owned: bool
    ) -> Stepper:
        """Return the stepper of this session's core, tied to the front's link and the recorder's feed."""
        assert self.front is not None
        chain = b""
        if self.feed is not None:
            header = self._make_header(core, OPEN if user_owned else CLOSED)
            shown = self.scenes.newest
            assets = ("", "") if shown is None else (shown.info.asset_root, shown.info.scene_hash)
            self.feed.send_header(header, *assets, label_robots(core.scene.robots, core.world))
            chain = header_root(header)
        keyframe_ns = round(self._config.keyframe_s * 1e9)
        past = self._past
        after = None if past is None else ResumedFrom(past.step, past.now_ns, past.anchors, past.is_gap_known)
        front, feed = self.front.link, self.feed
        stepper = Stepper(core, front, feed, clock, self.state_period_ns, keyframe_ns, chain, after)
        stepper.inputs = inputs
        stepper.on_scene.append(self._follow_scene)
        meshes = list_deformables(core.world) if self._published is None else self._published.deformables
        self._deformables = DeformableStreams(meshes, self._publish_vertices)
        stepper.on_publish.append(self._deformables.publish)
        return stepper

    def own_stream_names(self) -> frozenset[str]:
        """Return the media streams that carry the deformables of the scene."""
        return frozenset() if self._deformables is None else self._deformables.stream_names

    def _publish_vertices(
        self, stream: str, frames: dict[str, bytes], capture_ns: int, scene_epoch: int, encoding: str
    ) -> bool:
        if self.feed is not None:
            self.feed.add_vertices(stream, frames[BudgetClass.FULL], capture_ns)
        return self.front is not None and self.front.publish_media(stream, frames, capture_ns, scene_epoch, encoding)

    def _follow_scene(self, scene: NextScene | NextPatch) -> None:
        if self.front is not None:
            self.front.set_scene(scene.shown.info)
        if not isinstance(scene, NextScene):
            return
        if self._deformables is not None:
            self._deformables.replace_meshes(scene.deformables)
        if self.cameras is not None:
            self.cameras.follow_model(scene.packed_model)

    def _make_header(self, core: SessionCore, recording_class: str) -> SessionHeader:
        return SessionHeader(
            session_id=self.session_id,
            session_name=self.name,
            recording_class=recording_class,
            tick_period_ns=core.world.tick_period_ns,
            config=msgspec.msgpack.encode(core.current_config()),
            model=pack_model(core.world.encode_model()),
            scene_hash=core.world.scene_hash,
            robots=core.scene.robots,
            objects=core.scene.objects,
            bodies=core.world.bodies,
            versions=describe_environment(),
            created_utc=datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds"),
            continues=None if self._past is None else self._past.continues,
            origin_ns=self._origin_ns,
            boot_id=read_boot_id(),
            anchors=self._config.anchor_poses(),
            settings=make_settings(self._config),
            origin_utc_ns=time.time_ns() - time.monotonic_ns() + self._origin_ns,
        )

    def supervise(self, stepper: Stepper) -> None:
        """Restart what has died, and send a status report when one is due. Call after every step; acts every 50 ms."""
        now_ns = stepper.clock()
        if now_ns < self._next_supervise_ns:
            return
        self._next_supervise_ns = now_ns + SUPERVISE_PERIOD_NS
        self._save_resume_note()
        announcements: list[str] = []
        if self.front is not None:
            self.front.anchors = stepper.core.authority.anchors
            announcements += self.front.poll(now_ns)
        if self.recorder is not None and self.feed is not None:
            announcements += self.recorder.poll(now_ns, self.feed.silence_ns, self.feed.stats.recorder)
        for part in (self.web, self.cameras):
            announcements += [] if part is None else part.poll(now_ns)
        for text in announcements:
            self._announce(stepper, text)
        self._report_overflows(stepper)
        if self.front is not None and self.reporter.is_due(now_ns):
            self.front.link.send_report(self.make_report(stepper))

    def _announce(self, stepper: Stepper, text: str) -> None:
        """Announce an event of the session itself in the recording, to participants and in the log."""
        _log.warning("%s", text)
        stepper.inputs.post_own(Marker(request_id=0, text=text))

    def _report_overflows(self, stepper: Stepper) -> None:
        """Count the contacts that MuJoCo drops, which change what happens, and announce the first."""
        counts = stepper.core.world.dropped_counts
        for reason, count in counts.items():
            before = self._world_overflows.get(reason, 0)
            if reason not in self._overflows:
                self._announce(stepper, f"MuJoCo: {reason}; give the model <size memory='...'/>")
            added = count - before if count >= before else count  # less: the world was reset
            self._overflows[reason] = self._overflows.get(reason, 0) + added
        self._world_overflows = counts

    def make_report(self, stepper: Stepper) -> StatusReport:
        """Return the authority's half of a status report."""
        drops = self.count_own_drops()
        for reason in drops.keys() - self._dropped:
            _log.info("drops begin: %s", reason)
        self._dropped |= drops.keys()
        recorder, sizes = make_recorder_report(self.feed, self.recorder), self._config.sheet_sizes()
        return self.reporter.make_report(stepper, recorder, sizes, drops=drops, restarts=self.count_restarts())

    @property
    def front_pid(self) -> int:
        return 0 if self.front is None else self.front.pid

    def count_drops(self) -> dict[str, int]:
        """Return how much was not delivered, by reason."""
        return {**({} if self.front is None else self.front.link.status.drops), **self.count_own_drops()}

    def count_own_drops(self) -> dict[str, int]:
        """Return how much did not leave this process, by reason; the front counts the rest."""
        drops: dict[str, int] = {}
        if self.front is not None:
            drops["state_to_front"] = self.front.link.state_drops
        if self.feed is not None:
            drops["journal_rows"] = self.feed.stats.dropped_rows
            drops["recorded_items"] = self.feed.stats.dropped_items
            last = self.feed.stats.recorder
            refused = 0 if last is None else last.vertices_refused
            drops["recorded_vertices"] = self.feed.stats.dropped_vertices + refused
            drops["recorded_samples"] = 0 if last is None else last.samples_left_out
            drops["recorded_media"] = 0 if last is None else last.media_refused
            drops["recorded_assets"] = 0 if last is None else last.assets_left_out
        for part in (self.web, self.cameras):
            drops |= {} if part is None else part.drops
        drops |= self._overflows
        return {reason: count for reason, count in drops.items() if count}

    def count_restarts(self) -> dict[str, int]:
        """Return how often front and recorder were restarted, and the web gateway and cameras where they were."""
        parts = {"front": self.front, "recorder": self.recorder, "web": self.web, "cameras": self.cameras}
        counts = {name: 0 if part is None else part.restarts for name, part in parts.items()}
        return {name: n for name, n in counts.items() if n or name in ("front", "recorder")}

    def close(self) -> str:
        """End the front, which notifies its clients, then finish the recording. May be called twice.

        Returns:
            Why the recording is incomplete, in one line; empty when it is complete or nothing is recorded.
        """
        if self.cameras is not None:
            self.cameras.terminate()
        if self.front is not None:
            self.front.link.receive()
            self._save_resume_note()
            self.front.close(NOTIFY_S)
            self.front = None
        if self.web is not None:
            self.web.close()
            self.web = None
        if self.cameras is not None:
            self.cameras.close()
            self.cameras = None
        self.scenes.close()
        feed, self.feed = self.feed, None
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            recorder.stop_restarts()
        fault, is_accepted = "", True
        if feed is not None and recorder is not None:
            has_reported = feed.stats.recorders >= recorder.starts  # a new one is silent until it is up
            wait_s, silence_s = (ACCEPT_S, SILENCE_S) if has_reported else (START_S, STARTING_S)
            is_accepted = feed.close(wait_s, lambda: recorder.alive, silence_s, lambda: recorder.cpu_s)
            if not is_accepted:
                fault = recorder.failure or "the recorder did not write all of it in time"
                fault = f"the end of the recording is missing: {fault}"
            elif feed.stats.dropped_rows:
                fault = f"{feed.stats.dropped_rows} steps are missing in the recording: {feed.stats.drop_reason}"
        # A recorder that hangs has had its time: everything is to end within four seconds.
        if recorder is not None and not recorder.close(FINISH_S if is_accepted else HANGING_EXIT_S) and not fault:
            fault = "the recorder did not end in order: the end of the recording may be missing"
        if self._note_writer is not None:
            self._note_writer.close()
        if self._in_use is not None:
            self._in_use.release()
        self._note_writer = self._in_use = None
        if fault:
            _log.error("%s", fault)
        return fault


def make_settings(config: SessionConfig) -> Settings:
    """Return the settings that a resumed session takes over, for the header of the recording."""
    values = {name: getattr(config, name) for name in Settings.__struct_fields__}
    return Settings(**values | {"anchor_sizes": config.sheet_sizes(), "anchor_marks": config.mark_positions()})
