"""Run a demo: a session in this process, emulated operators in others, and a result with a verdict.

A run succeeds only if the session's own detector saw every handover by contact alone, if every goal with a deformable
was reached (`goals`), if the streams of its cameras reach every observer, and if the recording verifies bit for bit.
Handovers or goals are recorded as the verdict of an episode. When an operator fails, such as after dropping an object
where it cannot be grasped, the scene is reset and all begin again, as people do who record demonstrations. Planned
handovers are episodes of a task, each with its verdict. The demos themselves are in `demos`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from iris_session.client.stream_meter import StreamMeasurement
from iris_session.cloud.camera_file import load_camera_file
from iris_session.cloud.frames import SourceError
from iris_session.demo.demos import Demo
from iris_session.demo.goals import GoalMonitor
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.netsim.process import ImpairmentProcess, make_link_address
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.names import EpisodeAction, StreamFault
from iris_session.protocol.specs import TaskSpec
from iris_session.session.config import SessionConfig
from iris_session.session.session import Session
from iris_session.session.session_view import HandoverStatus
from iris_session.session.verification import verify_recording
from iris_session.system.extras import require_package
from iris_session.system.process import DEVNULL, PIPE, ChildProcess

#: Period at which the reports of the emulated headsets are read [ns].
READ_PERIOD_NS: Final = 100_000_000
#: Time to join the session that the demo itself started: a busy machine may be slow.
JOIN_TIMEOUT_S: Final = 60.0
#: Time for a deformable to come to rest after all operators are done [s], and time for operators to leave by themselves
#: after all goals are reached: one who is not content with the result would begin anew.
SETTLE_S: Final = 3.0
LEAVE_S: Final = 4.0
#: Nice value of emulated headsets where it is permitted: a headset has processors of its own.
HEADSET_NICE: Final = -5
#: Attempts at the whole demo, each after a reset, and time that must be left for another one [s].
MAX_ATTEMPTS: Final = 3
ATTEMPT_S: Final = 30.0
#: Every stream of a camera is measured for so long, and it is waited for so long after all operators are done [s].
MEASURE_S: Final = 3.0
STREAMS_S: Final = 20.0
#: Without a frame for so long at the end, a stream has stopped [s]; before, these faults, or none but staleness, may be
#: those of a busy computer.
SILENT_S: Final = 5.0
LATE_FAULTS: Final = ("", StreamFault.SLOW, StreamFault.SOURCE, StreamFault.POSE)
#: Time to find out whether cameras can be drawn here, and to compile the filter of their points, on a busy machine [s].
DRAW_S: Final = 120.0
#: Operators per process, when there are more than two; observers per process.
WORKERS_PER_PROCESS: Final = 2
OBSERVERS_PER_PROCESS: Final = 4


class EmulatorProcess:
    """Emulated headsets in a process of their own. `poll()` reads their reports without waiting."""

    def __init__(self, address: str, specs: Sequence[HeadsetSpec], seconds: float) -> None:
        options = ["--address", address, "--specs", "-", "--json", "--join-timeout", str(JOIN_TIMEOUT_S)]
        self._process = ChildProcess(
            "iris_session.emulator",
            [*options, "--seconds", str(seconds)],
            config=msgspec.json.encode(list(specs)),
            stdout=PIPE,
            own_session=True,
        )
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, HEADSET_NICE)
        self._awaited = [spec.name for spec in specs if not spec.endless]
        self.reports: dict[str, HeadsetReport] = {}

    @property
    def is_running(self) -> bool:
        return self._process.is_running

    @property
    def is_busy(self) -> bool:
        """True until every task that has an end is done or failed."""
        reports = [self.reports.get(name) for name in self._awaited]
        return any(r is None or not (r.done or r.failed) for r in reports)

    def poll(self) -> None:
        """Read the newest report of each headset."""
        for line in self._process.read_available_lines():
            report = msgspec.json.decode(_nan_for_null(line), type=HeadsetReport, strict=False)
            self.reports[report.name] = report

    def close(self) -> None:
        """End the process if it still runs, and read its last reports. Can be called twice."""
        self._process.stop(terminate_s=5.0)
        self.poll()
        self._process.close()


def _nan_for_null(line: bytes) -> bytes:
    """JSON has no NaN: msgspec writes null for it; a report without the field has NaN again."""
    pairs: dict[str, Any] = msgspec.json.decode(line)
    return msgspec.json.encode({key: value for key, value in pairs.items() if value is not None})


class GoalStatus(msgspec.Struct, frozen=True):
    """Outcome of a goal: simulated time `at_s` at which it was reached, `None` when it was not."""

    deformable: str
    goal: str
    at_s: float | None


class DemoResult(msgspec.Struct, frozen=True):
    """Result of a demo, as printed by `demo NAME --json`.

    `alignment_mm`: stated p95 and true error at the sheet [mm], by name of the headset, of the aligned ones only.
    `attempts` (`takes` in JSON): each from a reset scene; `handovers` and `goals` are those of the last one.
    `streams`: the cloud and the pictures of the cameras as they came to each observer, with rate and age, by its name.
    `episodes`: verdicts of a planned handover, whose `handovers` are those of all episodes.
    """

    ok: bool
    demo: str
    seconds: float
    participants: tuple[str, ...]
    handovers: tuple[HandoverStatus, ...]
    recording: str | None
    verified: bool | None
    verification: str
    alignment_mm: dict[str, dict[str, float]]
    late_tick_share: float
    lateness_ms_p99: float
    state_age_ms_p99: dict[str, float]
    problems: tuple[str, ...]
    real_time_factor: float = 0.0
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    goals: tuple[GoalStatus, ...] = ()
    attempts: int = msgspec.field(name="takes", default=1)
    streams: dict[str, tuple[StreamMeasurement, ...]] = {}
    episodes: tuple[str, ...] = ()


def run_demo(
    demo: Demo,
    config: SessionConfig,
    timeout_s: float = 90.0,
    on_session: Callable[[Session], AbstractContextManager[Callable[[], object]]] | None = None,
    profile: str = "",
    seed: int = 0,
) -> DemoResult:
    """Run `demo` to its end. `on_session`: a context around the running session that yields a function for every loop.

    `profile`: each emulator process joins over an impaired link of this profile, with `seed`; empty: directly.
    Raises `SourceError` before anything is started if the cameras of the demo cannot be drawn here.
    """
    _check_cameras(demo)
    session = Session(demo.model, config=_make_config(demo, config))
    judge = _GoalTracker(demo, session)
    episodes = None if demo.task is None else _EpisodeKeeper(demo, demo.task, session)
    with ExitStack() as stack:
        stack.enter_context(session.signals())
        stack.enter_context(session)
        update = stack.enter_context(on_session(session)) if on_session is not None else (lambda: None)
        groups = _group_by_process(demo.headsets)
        addresses = _open_links(stack, session, len(groups), profile, seed)
        people = stack.enter_context(_EmulatorGroup(addresses, groups, timeout_s))
        next_read_ns = began_ns = attempt_ns = 0
        failed_attempts: list[str] = []

        def finished() -> bool:
            nonlocal next_read_ns, began_ns, attempt_ns
            update()
            now_ns = session.clock()
            began_ns = began_ns or now_ns  # preparing the loop is not part of its pace
            judge.update(people.are_working)
            if now_ns < next_read_ns:
                return False
            next_read_ns = now_ns + READ_PERIOD_NS
            is_over = (people.is_finished() and judge.is_settled()) or judge.is_reached_for(LEAVE_S)
            is_over = is_over and people.have_seen_streams(now_ns)
            failures = judge.list_failures(people.list_failures(), is_over)
            left_s = timeout_s - (now_ns - began_ns) * 1e-9
            if episodes is not None:
                return episodes.update(people, is_over, failures, left_s)
            if failures and len(failed_attempts) < MAX_ATTEMPTS - 1 and left_s > ATTEMPT_S:
                failed_attempts.append(f"begun again at {now_ns * 1e-9:.0f} s: {'; '.join(failures)}")
                judge.restart()
                session.reset()
                people.restart(left_s)  # ticks wait until the old processes have ended; nothing is driven meanwhile
                attempt_ns = now_ns
                return False
            return is_over

        session.run(seconds=timeout_s + 5.0, until=finished)
        run_s = max(session.clock() - max(began_ns, attempt_ns), 1) * 1e-9
        watched = people.reports  # while the session ran
        people.close()
        camera_problems, camera_notes = _list_camera_faults(demo, watched, session)
        interrupted = session.stopping
        status = session.status()
        seconds, recording = session.clock() * 1e-9, session.recording
    reports = people.reports
    handovers = tuple(one for one in status.handovers if one.at_s * 1e9 >= attempt_ns)
    # Ctrl-C requests an immediate end; `iris-session verify` has all the time it needs.
    verified, verification = (None, "not verified: interrupted") if interrupted else _verify_recording(recording)
    problems = judge.list_problems()
    if problems or not demo.goals:
        problems = _list_problems(demo, reports, handovers, timeout_s) + problems
    problems = problems if episodes is None else episodes.list_problems()
    problems = ["interrupted before its end"] if interrupted else [*problems, *camera_problems]
    problems += filter(None, (session.recording_fault, verification if verified is False else ""))
    return DemoResult(
        ok=not problems and len(reports) == len(demo.headsets),
        demo=demo.name,
        seconds=round(seconds, 3),
        participants=tuple(sorted(reports)),
        handovers=handovers,
        recording=None if recording is None else str(recording),
        verified=verified,
        verification=verification,
        alignment_mm={
            name: {"stated_p95": round(r.stated_error_mm, 2), "at_sheet": round(r.alignment_error_mm, 2)}
            for name, r in reports.items()
            if math.isfinite(r.stated_error_mm)
        },
        late_tick_share=status.lateness.get("late_share", 0.0),
        lateness_ms_p99=round(status.lateness.get("p99_ms", 0.0), 3),
        real_time_factor=round(status.sim_time / run_s if episodes is None else episodes.pace, 3),
        state_age_ms_p99={name: round(r.age_ms_p99, 2) for name, r in reports.items() if math.isfinite(r.age_ms_p99)},
        problems=tuple(problems),
        notes=(*demo.notes, *failed_attempts, *camera_notes, *(() if episodes is None else episodes.notes)),
        interrupted=interrupted,
        goals=judge.get_status(),
        attempts=1 + len(failed_attempts),
        streams={name: r.streams for name, r in watched.items() if r.streams},
        episodes=() if episodes is None else tuple(episodes.verdicts),
    )


def _make_config(demo: Demo, config: SessionConfig) -> SessionConfig:
    """Return the configuration of the session of a demo."""
    cameras, task = (*demo.cameras, *config.cameras), demo.task or config.task
    return dataclasses.replace(config, anchors=demo.anchors, anchor_sizes=demo.anchor_sizes, cameras=cameras, task=task)


def _open_links(stack: ExitStack, session: Session, n: int, profile: str, seed: int) -> list[str]:
    """Return the address of the session for each of `n` processes, over an impaired link each with a `profile`."""
    if not profile:
        return [session.address] * n
    ports, links = session.processes.front_ports, [make_link_address(i) for i in range(n)]
    profiles = dict.fromkeys(links, profile)
    stack.enter_context(ImpairmentProcess(profiles, ports.for_clients, target=ports.host, seed=seed))
    return [f"{link}:{ports.control}" for link in links]


class _GoalTracker:
    """Tracks goals, or else handovers, of a demo tick by tick, and records the verdict as that of an episode."""

    def __init__(self, play: Demo, session: Session) -> None:
        self._name = play.name
        self._session = session
        self._monitors = tuple(GoalMonitor(goal) for goal in play.goals)
        self._objects = () if play.goals or play.task is not None else play.objects
        self._began_s, self._is_given = 0.0, False
        self._began = False
        self._finished_s: float | None = None

    def restart(self) -> None:
        """Forget what was reached; the episode is discarded."""
        if self._began:
            for _ in range(2):  # it is asked for twice
                self._session.post(Episode(0, EpisodeAction.DISCARD, self._name))
        self._monitors = tuple(GoalMonitor(one.goal) for one in self._monitors)
        self._began, self._finished_s = False, None

    def update(self, are_working: Callable[[], bool]) -> None:
        """Process one tick. The episode begins when people work: a robot that waits is no demonstration."""
        if not (self._monitors or self._objects) or not (self._began or are_working()):
            return
        if not self._began:
            self._began, self._began_s, self._is_given = True, self._session.clock() * 1e-9, False
            self._session.post(Episode(0, EpisodeAction.START, self._name, countdown_ns=0))
        if self._objects and not self._is_given:
            seen = {one.object for one in self._session.stepper.view.handovers if one.at_s >= self._began_s}
            self._is_given = seen.issuperset(self._objects)
            if self._is_given:
                self._session.post(Episode(0, EpisodeAction.SUCCESS, self._name))
        world = self._session.stepper.core.world
        now_s, reached = world.view().sim_time, False
        for watch in self._monitors:
            name = watch.goal.deformable
            reached |= watch.update(now_s, world.flexes.read_vertices(name), world.flexes.find_touching_robots(name))
        if reached and all(watch.at_s is not None for watch in self._monitors):
            self._session.post(Episode(0, EpisodeAction.SUCCESS, self._name))

    def is_reached_for(self, seconds: float) -> bool:
        """Return True if there are goals, and all were reached at least so long ago."""
        reached = [watch.at_s for watch in self._monitors if watch.at_s is not None]
        now_s = self._session.stepper.core.world.view().sim_time
        return 0 < len(reached) == len(self._monitors) and now_s - max(reached) >= seconds

    def list_failures(self, of_operators: list[str], is_over: bool) -> list[str]:
        """Return why the attempt has failed: none once the goals are reached, whatever operators still meant to do."""
        if self.is_reached_for(0.0):
            return []
        return of_operators or (self.list_problems() if is_over else [])

    def is_settled(self) -> bool:
        """Return True, once all tasks are done, when the goals are reached or evidently will not be."""
        now_s = self._session.clock() * 1e-9
        self._finished_s = now_s if self._finished_s is None else self._finished_s
        return all(watch.at_s is not None for watch in self._monitors) or now_s - self._finished_s > SETTLE_S

    def get_status(self) -> tuple[GoalStatus, ...]:
        return tuple(
            GoalStatus(w.goal.deformable, w.goal.name, None if w.at_s is None else round(w.at_s, 3))
            for w in self._monitors
        )

    def list_problems(self) -> list[str]:
        """Return one line per goal that was not reached."""
        return [
            f"the {w.goal.deformable} was not {w.goal.name}, released and at rest"
            for w in self._monitors
            if w.at_s is None
        ]


class _EpisodeKeeper:
    """Records every attempt at a planned handover as an episode of its task, which resets the scene at its end.

    It is a success only if the session saw the handover and the receiver alone holds the object, free of everything
    else.

    Attributes:
        verdicts: Of the episodes so far.
        notes: Why some are failures.
        pace: Simulated time per second, from the reset of the scene to the last verdict.
    """

    def __init__(self, demo: Demo, task: TaskSpec, session: Session) -> None:
        self._session, self._task = session, task
        (self._object,) = demo.objects
        self._giver, self._receiver = task.robots
        self.verdicts: list[str] = []
        self.notes: list[str] = []
        self._runs = self._is_judged = False
        self._began_s = self._reset_s = 0.0
        self.pace = 0.0

    @property
    def is_complete(self) -> bool:
        """True when there are as many successes as wanted, or too many failures."""
        successes = self.verdicts.count(EpisodeAction.SUCCESS)
        return successes >= self._task.wanted or len(self.verdicts) - successes >= MAX_ATTEMPTS

    def update(self, people: _EmulatorGroup, is_over: bool, failures: list[str], left_s: float) -> bool:
        """Begin an episode once all people work, and give its verdict when they are done; then others begin anew.

        Returns True after the last one. People leave when the session has the verdict: before, it would be unknown.
        """
        if self._is_judged:
            self._is_judged = False
            if self.is_complete or left_s < ATTEMPT_S:
                return True
            people.restart(left_s)
            return False
        if not self._runs and people.are_working():
            self._runs, self._began_s = True, self._session.clock() * 1e-9
            self._session.post(Episode(0, EpisodeAction.START, f"{self._giver} to {self._receiver}", countdown_ns=0))
        if not (is_over or failures):
            return False
        problems = failures or self._judge()
        now_s, sim_s = self._session.clock() * 1e-9, self._session.stepper.core.world.view().sim_time
        self.pace, self._reset_s = sim_s / (now_s - self._reset_s), now_s
        verdict = EpisodeAction.FAILURE if problems else EpisodeAction.SUCCESS
        self.verdicts.append(verdict)
        self.notes += [f"episode {len(self.verdicts)}: {problem}" for problem in problems]
        if self._runs:
            self._session.post(Episode(0, verdict))
        self._runs, self._is_judged = False, True
        return False

    def list_problems(self) -> list[str]:
        """Return one line if there are fewer successes than wanted."""
        successes = self.verdicts.count(EpisodeAction.SUCCESS)
        wanted = self._task.wanted
        return [] if successes >= wanted else [f"{successes} of {wanted} handovers of the {self._object} succeeded"]

    def _judge(self) -> list[str]:
        """Return why the present episode is no success."""
        seen = [one for one in self._session.status().handovers if one.at_s >= self._began_s]
        if (self._object, self._giver, self._receiver) not in [(h.object, h.giver, h.receiver) for h in seen]:
            return [f"the detector saw no handover of the {self._object} by contact alone"]
        contacts = self._session.stepper.core.world.view().object_contacts()
        held = [c for c in contacts if c.object == self._object and c.touching == (self._receiver,) and not c.others]
        return [] if held else [f"'{self._receiver}' does not hold the {self._object} alone"]


def _group_by_process(specs: Sequence[HeadsetSpec]) -> list[Sequence[HeadsetSpec]]:
    """Group headsets by process: one each for up to two operators, else `WORKERS_PER_PROCESS`."""
    workers = [spec for spec in specs if not spec.observer]
    observers = [spec for spec in specs if spec.observer]
    each = 1 if len(workers) <= 2 else WORKERS_PER_PROCESS
    groups: list[Sequence[HeadsetSpec]] = [workers[i : i + each] for i in range(0, len(workers), each)]
    return groups + [observers[i : i + OBSERVERS_PER_PROCESS] for i in range(0, len(observers), OBSERVERS_PER_PROCESS)]


class _EmulatorGroup:
    """The emulated headsets of a demo, in their own processes."""

    def __init__(self, addresses: Sequence[str], groups: Sequence[Sequence[HeadsetSpec]], timeout_s: float) -> None:
        self._addresses, self._groups = addresses, groups
        self._workers: list[EmulatorProcess] = []
        self._observers: list[EmulatorProcess] = []
        self.restart(timeout_s)

    def restart(self, timeout_s: float) -> None:
        """End all processes, and start them anew."""
        self.close()
        self._workers, self._observers = [], []
        self._awaited_ns = 0
        try:
            for address, group in zip(self._addresses, self._groups, strict=True):
                if group[0].observer:
                    self._observers.append(EmulatorProcess(address, group, timeout_s + 5.0))
                else:
                    self._workers.append(EmulatorProcess(address, group, timeout_s))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def reports(self) -> dict[str, HeadsetReport]:
        """The newest report of each headset, by name."""
        return {name: r for process in (*self._workers, *self._observers) for name, r in process.reports.items()}

    def is_finished(self) -> bool:
        """Read the reports and return True when every task that has an end has ended."""
        for process in (*self._workers, *self._observers):
            process.poll()
        return not any(process.is_running and process.is_busy for process in self._workers)

    def are_working(self) -> bool:
        """Return True when all operators have their robots and are at work, or done."""
        reports = [r for process in self._workers for r in process.reports.values()]
        return len(reports) == sum(len(group) for group in self._groups if not group[0].observer) and all(
            report.phase in ("work", "done") for report in reports
        )

    def have_seen_streams(self, now_ns: int) -> bool:
        """Return True when all streams were measured for long enough, or `STREAMS_S` after the first call."""
        self._awaited_ns = self._awaited_ns or now_ns
        seen = {
            (name, one.stream)
            for name, report in self.reports.items()
            for one in report.streams
            if one.frames and one.seconds >= MEASURE_S
        }
        missing = {(spec.name, stream) for group in self._groups for spec in group for stream in spec.streams} - seen
        return not missing or now_ns - self._awaited_ns > STREAMS_S * 1e9

    def list_failures(self) -> list[str]:
        """Return one line per operator that has failed."""
        return _list_failures(self.reports)

    def close(self) -> None:
        for process in (*self._workers, *self._observers):
            process.close()


def _check_cameras(play: Demo) -> None:
    """Raise `SourceError` if cameras cannot be drawn here: a session would only say it of its streams."""
    for path in play.cameras:
        require_package("cv2", "pictures of cameras")
        config = msgspec.msgpack.encode(load_camera_file(path))
        module = "iris_session.cloud.sources.mujoco_camera"
        with ChildProcess(module, config=config, stdout=PIPE, stderr=DEVNULL) as child:
            status = child.wait(DRAW_S)
            said = b" ".join(child.read_available_lines()).decode(errors="replace")
        if status != 0:
            ended = f"did not end within {DRAW_S:.0f} s" if status is None else f"ended with status {status}"
            why = said or f"opening them {ended}"
            raise SourceError(f"demo {play.name} draws what its cameras see: {why}")


def _list_camera_faults(play: Demo, reports: dict[str, HeadsetReport], session: Session) -> tuple[list[str], list[str]]:
    """Return problems and notes about the cameras, by what observers saw and what their processes say.

    Cameras whose frames come late are no problem: they get what ticks and headsets leave them of the processors.
    """
    problems: list[str] = []
    notes: list[str] = []
    for spec in play.headsets:
        measured = {one.stream: one for one in reports[spec.name].streams} if spec.name in reports else {}
        for stream in spec.streams:
            one = measured.get(stream, StreamMeasurement(stream))
            said = f"{one.fault}: {one.detail}" if one.fault else ""
            if not one.frames:
                problems.append(f"{spec.name}: no frame of the stream '{stream}' came{said and ', '}{said}")
            elif one.stale or said or one.silent_s > SILENT_S:
                late = one.fault in LATE_FAULTS and one.silent_s <= SILENT_S
                text = f"{spec.name}: the stream '{stream}' is {said or 'stale'}, newest frame {one.silent_s:.1f} s ago"
                (notes if late else problems).append(text)
    cameras = session.processes.cameras
    if cameras is not None:
        problems += cameras.list_warnings()
        if cameras.restarts:
            problems.append(f"the camera process ended and was started again, {cameras.restarts} times")
    return problems, notes


def _list_problems(
    play: Demo, reports: dict[str, HeadsetReport], handovers: Sequence[HandoverStatus], timeout_s: float
) -> list[str]:
    """Return the reasons why the demo failed, empty after a success."""
    tasks = {spec.name: spec for spec in play.headsets}
    problems = _list_failures(reports)
    problems += [
        f"{name}: not done within {timeout_s:g} s, at '{r.phase}'"
        for name, r in reports.items()
        if not (r.done or r.failed or tasks[name].endless)
    ]
    given = {handover.object for handover in handovers}
    problems += [
        f"the detector saw no handover of the {thing} by contact alone" for thing in play.objects if thing not in given
    ]
    return problems


def _list_failures(reports: dict[str, HeadsetReport]) -> list[str]:
    return [f"{name}: {report.failed}" for name, report in reports.items() if report.failed]


def _verify_recording(recording: Path | None) -> tuple[bool | None, str]:
    if recording is None:
        return None, "not recorded"
    report = verify_recording(recording)
    return report.ok, report.line()
