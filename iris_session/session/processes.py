"""The processes of a session besides the authority: front and recorder. Started, watched, replaced, ended.

A front that dies is replaced on the same ports (clients reconnect and resume); a recorder that dies is replaced and
goes on in a new part of the recording. Both are announced, neither stops a step. A process that dies again and again
is tried at growing distances.
"""

from __future__ import annotations

import datetime
import importlib.util
import logging
import math
import secrets
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from iris_session.link import FrontConfig, FrontError, FrontProcess, addresses_of
from iris_session.link.sockets import host_in_address
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.names import BudgetClass
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
from iris_session.recording.environment import describe_environment, read_boot_id
from iris_session.recording.feed import SILENCE_S
from iris_session.scene.composed import ComposedScene
from iris_session.session.config import SessionConfig
from iris_session.session.continuation import Continuation, wait_until_free
from iris_session.session.core import SessionCore
from iris_session.session.deformables import Bending, DeformableStreams, flexes
from iris_session.session.errors import StartError
from iris_session.session.report import Reporter
from iris_session.session.resume_note import Listening, NoteKeeper, ResumeNote, note_path
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.stepper import NextPatch, NextScene, ResumedFrom, Stepper
from iris_session.session.supervision import Backoff, RecorderSupervisor, replaced
from iris_session.session.unique_name import Neighbours

#: Ports of media and assets, from the port of state: 7723, 7726 and 7724 by default.
MEDIA_OFFSET: Final = 1
INGEST_OFFSET: Final = 4
ASSETS_OFFSET: Final = 2
WATCH_PERIOD_NS: Final = 50_000_000
#: What the recorder gets to take what is left, and one that was just started before.
TAKING_S: Final = 5.0
STARTING_S: Final = 15.0
#: What the front gets to tell its clients, a recorder to finish its file, and one that did not take its rows to end.
FAREWELL_S: Final = 0.6
FINISHING_S: Final = 10.0
ENDING_S: Final = 0.2

_log = logging.getLogger(__name__)


class Composed(NamedTuple):
    """A scene whose world is not MuJoCo's: what clients draw, and what bends in it."""

    scene: ComposedScene
    bending: tuple[Bending, ...]


class SessionProcesses:
    """Front and recorder of one session. `start` raises `StartError` with one line.

    `composed`: the scene of `core`, where it cannot be read off its model.
    """

    def __init__(
        self,
        config: SessionConfig,
        core: SessionCore,
        origin_ns: int,
        past: Continuation | None = None,
        composed: Composed | None = None,
    ) -> None:
        self._config = config
        self._origin_ns = origin_ns
        self._past = past
        self.session_id = secrets.token_hex(8) if past is None else past.header.session_id
        self.name = config.name
        #: What people should know about how the session started.
        self.notes: list[str] = []
        self.recording = config.recording_path() if past is None else past.recording
        self._in_use: RecordingLock | None = None
        self._keeper: NoteKeeper | None = None
        self._core = core
        self._bending = None if composed is None else composed.bending
        scene = None if composed is None else composed.scene
        self.scenes = SharedScenes(config.assets, config.name, scene, sites=config.sites, tendons=config.tendons)
        self.state_period_ns = round(1e9 / config.state_hz)
        self.recorder: RecorderProcess | None = None
        self.feed: RecorderFeed | None = None
        self.front: FrontProcess | None = None
        self._deformables: DeformableStreams | None = None
        self._front_backoff = Backoff()
        #: Of the recorder, None when nothing is recorded.
        self.supervisor: RecorderSupervisor | None = None
        self.reporter = Reporter()
        self._next_watch_ns = 0
        self._address = ""
        #: What MuJoCo had no room for, since the beginning; and as the world counts it, since its last reset.
        self._trouble: dict[str, int] = {}
        self._trouble_seen: dict[str, int] = {}

    def start(self) -> None:
        """Starts the recorder, then the front; ends both again when one fails."""
        if self.recording is not None and importlib.util.find_spec("rerun") is None:
            raise StartError("recording needs rerun: pip install 'iris-session[recording]', or record nothing")
        others = Neighbours(self._config.beacon_port)
        try:
            if self.recording is not None:
                self.recorder = RecorderProcess(self.recording, self._origin_ns)
                self.recorder.start()
                self.supervisor = RecorderSupervisor(self.recorder)
                self.feed = RecorderFeed(
                    self.recorder.feed_endpoint,
                    self.recording.parent,
                    vertices_endpoint=self.recorder.vertices_endpoint,
                )
                self._in_use = RecordingLock(self.recording, shared=True)
                if not self._core.config.authority.user_owned_loop:  # else nobody can go on from the recording
                    self._keeper = NoteKeeper(note_path(self.recording))
            self.name = others.free_name(self._config.name, self.session_id)
            self.notes += others.notes
            self.front = FrontProcess(
                self._front_config(),
                self.scenes.take(
                    self.scenes.make(self._core.world, self._core.scene.initial_state, self._core.authority.patches)
                ),
            )
            if self._past is not None:
                self.notes += self._past.notes
                self.front.link.handback = self._past.handback
                wait_until_free(self._config)
            ports = self.front.start()
            self._note()
            self._address = f"{ports.host}:{ports.control}"
            others_join_at = [f"{host_in_address(host)}:{ports.control}" for host in ports.reachable]
            if ports.key_fingerprint:
                how = "keys in that folder join" if self._config.curve_clients else "new devices: `iris-session pair`"
                self.notes.append(f"encrypted, key {ports.key_fingerprint}; {how}")
            if others_join_at != [self._address]:
                self.notes.append(f"others reach it at {', '.join(others_join_at)}")
        except (FrontError, RecordingError) as error:
            self.close()
            raise StartError(str(error)) from None  # whose text says it all
        except BaseException:
            self.close()
            raise
        finally:
            others.close()

    def _note(self) -> None:
        """What a resumed session needs and the journal does not have: the front's memory, and where it listens."""
        if self._keeper is None or self.front is None or self.front.link.ports is None:
            return
        config, ports = self._config, self.front.link.ports
        listening = Listening(
            config.host,
            config.interfaces,
            config.advertise,
            config.beacon_port,
            ports.control,
            ports.state,
            config.curve,
            config.curve_key,
            config.curve_clients,
        )
        self._keeper.offer(ResumeNote(self.session_id, listening, self.front.link.handback))

    def _front_config(self) -> FrontConfig:
        config = self._config
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
            adapt_media=config.adapt_media,
            session_id=self.session_id,
            session_name=self.name,
            origin_ns=self._origin_ns,
            state_period_ns=self.state_period_ns,
            curve=config.curve,
            curve_secret_file=config.curve_key,
            curve_clients_dir=config.curve_clients,
            anchors=config.anchor_poses(),
            anchor_sizes=config.sheet_sizes(),
            recorder_endpoint="" if self.recorder is None else self.recorder.samples_endpoint,
        )

    @property
    def address(self) -> str:
        """`host:port` of the control channel; it stays the same when the front is replaced."""
        return self._address

    def make_stepper(self, core: SessionCore, clock: Callable[[], int], *, user_owned: bool) -> Stepper:
        """The stepper of this session's core, tied to the front's link and the recorder's feed."""
        assert self.front is not None
        chain = b""
        if self.feed is not None:
            header = self._header(core, OPEN if user_owned else CLOSED)
            shown = self.scenes.newest
            self.feed.send_header(header, *(() if shown is None else (shown.info.asset_root, shown.info.scene_hash)))
            chain = header_root(header)
        keyframe_ns = round(self._config.keyframe_s * 1e9)
        past = self._past
        after = None if past is None else ResumedFrom(past.step, past.now_ns, past.anchors)
        front, feed = self.front.link, self.feed
        stepper = Stepper(core, front, feed, clock, self.state_period_ns, keyframe_ns, chain, after)
        stepper.on_scene.append(self._scene_changed)
        bending = flexes(core.world) if self._bending is None else self._bending
        self._deformables = DeformableStreams(bending, self._publish_vertices)
        stepper.beside_state.append(self._deformables.send)
        return stepper

    def own_streams(self) -> frozenset[str]:
        """Media streams that carry what bends in the scene."""
        return frozenset() if self._deformables is None else self._deformables.streams

    def _publish_vertices(
        self, stream: str, frames: dict[str, bytes], capture_ns: int, scene_epoch: int, encoding: str
    ) -> bool:
        if self.feed is not None:
            self.feed.send_vertices(stream, frames[BudgetClass.FULL], capture_ns)
        return self.front is not None and self.front.publish_media(stream, frames, capture_ns, scene_epoch, encoding)

    def _scene_changed(self, scene: NextScene | NextPatch) -> None:
        if self.front is not None:
            self.front.set_scene(scene.shown.info)
        if self._deformables is not None and isinstance(scene, NextScene):
            self._deformables.use(scene.bending)

    def _header(self, core: SessionCore, recording_class: str) -> SessionHeader:
        return SessionHeader(
            session_id=self.session_id,
            session_name=self.name,
            recording_class=recording_class,
            tick_period_ns=core.world.tick_period_ns,
            config=msgspec.msgpack.encode(core.as_it_is()),
            model=pack_model(core.world.model_bytes()),
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
            settings=settings_of(self._config),
        )

    def watch(self, stepper: Stepper) -> None:
        """Replaces what has died. Call after every step: it looks at most every 50 ms."""
        now_ns = stepper.clock()
        if now_ns < self._next_watch_ns:
            return
        self._next_watch_ns = now_ns + WATCH_PERIOD_NS
        self._note()
        if self.front is not None and not self.front.alive and self._front_backoff.dead(now_ns):
            self.front.set_anchors(stepper.core.authority.anchors)
            fault = self.front.fault or "ended"
            what = replaced(self.front.restart, FrontError)
            stepper.say(Marker(request_id=0, text=f"the front process {fault} and {what}"))
        if self.supervisor is not None and self.feed is not None:
            for text in self.supervisor.look(now_ns, self.feed.silence_ns):
                stepper.say(Marker(request_id=0, text=text))
        self._watch_plant(stepper)
        if self.front is not None and self.reporter.due(now_ns):
            self.front.link.send_report(self.reporter.report(stepper, self))

    def _watch_plant(self, stepper: Stepper) -> None:
        """Contacts that MuJoCo drops change what happens: said once, and counted."""
        seen = stepper.core.world.trouble
        for what, count in seen.items():
            before = self._trouble_seen.get(what, 0)
            if what not in self._trouble:
                stepper.say(Marker(request_id=0, text=f"MuJoCo: {what}; give the model <size memory='...'/>"))
            self._trouble[what] = self._trouble.get(what, 0) + (count - before if count >= before else count)
        self._trouble_seen = seen

    @property
    def front_pid(self) -> int:
        return 0 if self.front is None else self.front.pid

    @property
    def recorder_pid(self) -> int:
        return 0 if self.recorder is None else self.recorder.pid

    @property
    def sheet_sizes(self) -> dict[str, float]:
        """Edge of the printed sheets [m], of those whose size is known."""
        return self._config.sheet_sizes()

    def drops(self) -> dict[str, int]:
        """Everything that was not delivered, by reason."""
        return {**({} if self.front is None else self.front.link.status.drops), **self.own_drops()}

    def own_drops(self) -> dict[str, int]:
        """What did not leave this process, by reason; the front counts the rest."""
        drops: dict[str, int] = {}
        if self.front is not None:
            drops["state_to_front"] = self.front.link.state_drops
        if self.feed is not None:
            drops["journal_rows"] = self.feed.stats.dropped_rows
            drops["recorded_items"] = self.feed.stats.dropped_items
            said = self.feed.stats.recorder
            refused = 0 if said is None else said.vertices_refused
            drops["recorded_vertices"] = self.feed.stats.dropped_vertices + refused
        drops |= self._trouble
        return {reason: count for reason, count in drops.items() if count}

    def restarts(self) -> dict[str, int]:
        recorder = 0 if self.supervisor is None else self.supervisor.restarts
        return {"front": self._front_backoff.restarts, "recorder": recorder}

    def close(self) -> str:
        """Ends the front (its clients are told), then finishes the recording. May be called twice.

        Why the recording is incomplete, one line; empty when it holds everything, or when nothing is recorded.
        """
        if self.front is not None:
            self.front.link.receive()
            self._note()
            self.front.close(FAREWELL_S)
            self.front = None
        self.scenes.close()
        if self.supervisor is not None:
            self.supervisor.close()
        feed, self.feed = self.feed, None
        recorder, self.recorder, self.supervisor = self.recorder, None, None
        fault, taken = "", True
        if feed is not None and recorder is not None:
            known = feed.stats.recorders >= recorder.starts  # a new one says nothing until it is there
            wait_s, silence_s = (TAKING_S, SILENCE_S) if known else (STARTING_S, math.inf)
            taken = feed.close(wait_s, lambda: recorder.alive, silence_s)
            if not taken:
                fault = recorder.failure or "the recorder did not write all of it in time"
                fault = f"the end of the recording is missing: {fault}"
            elif feed.stats.dropped_rows:
                fault = f"{feed.stats.dropped_rows} steps are missing in the recording: {feed.stats.spill_fault}"
        # One that hangs has had its time: everything is to end within two seconds.
        if recorder is not None and not recorder.close(FINISHING_S if taken else ENDING_S) and not fault:
            fault = "the recorder did not end in order: the end of the recording may be missing"
        if self._keeper is not None:
            self._keeper.close()
        if self._in_use is not None:
            self._in_use.release()
        self._keeper = self._in_use = None
        if fault:
            _log.error("%s", fault)
        return fault


def settings_of(config: SessionConfig) -> Settings:
    """What a resumed session takes over, as it is noted in the recording."""
    return Settings(
        config.state_hz, config.keyframe_s, config.realtime, config.adapt_media, anchor_sizes=config.sheet_sizes()
    )
