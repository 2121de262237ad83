"""Runs a demo: a session in this process, emulated people in others, and a result that says whether it worked.

It counts only if the session's own detector saw every object change hands by contact alone, if every goal with a
deformable was reached (`goals`; told in the recording as the verdict of an episode), and if the recording verifies bit
for bit. What is played is in `plays`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from iris_session.demo.goals import GoalWatch
from iris_session.demo.plays import Play
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.netsim.process import ImpairmentProcess, link_address
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.names import EpisodeAction
from iris_session.session.config import SessionConfig
from iris_session.session.ledger import HandoverStatus
from iris_session.session.session import Session
from iris_session.session.status import SessionStatus
from iris_session.session.verification import verify_recording
from iris_session.system.process import PIPE, ChildProcess

#: How often the reports of the emulated people are read [ns].
READ_PERIOD_NS: Final = 100_000_000
#: Until the session that the demo itself started lets its people in: a busy machine may take its time.
JOIN_TIMEOUT_S: Final = 60.0
#: So long a deformable may take to come to rest after everybody is done [s].
SETTLE_S: Final = 3.0
#: People who work share a process in pairs, people who only look in fours.
WORKERS_PER_PROCESS: Final = 2
OBSERVERS_PER_PROCESS: Final = 4


class EmulatorProcess:
    """Emulated people in a process of their own. `poll()` reads what they report, without waiting."""

    def __init__(self, address: str, specs: Sequence[HeadsetSpec], seconds: float) -> None:
        options = ["--address", address, "--specs", "-", "--json", "--join-timeout", str(JOIN_TIMEOUT_S)]
        self._process = ChildProcess(
            "iris_session.emulator",
            [*options, "--seconds", str(seconds)],
            config=msgspec.json.encode(list(specs)),
            stdout=PIPE,
            own_session=True,
        )
        self._awaited = [spec.name for spec in specs if not spec.endless]
        self.reports: dict[str, HeadsetReport] = {}

    @property
    def running(self) -> bool:
        return self._process.is_running

    @property
    def busy(self) -> bool:
        """Whether somebody here has not yet come to the end of a task that has one."""
        reports = [self.reports.get(name) for name in self._awaited]
        return any(r is None or not (r.done or r.failed) for r in reports)

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> None:
        """Takes over the newest report of each person."""
        for line in self._process.read_available_lines():
            report = msgspec.json.decode(_nan_for_null(line), type=HeadsetReport, strict=False)
            self.reports[report.name] = report

    def close(self) -> None:
        """Ends the process if it still runs, and reads its last words. Can be called twice."""
        self._process.stop(terminate_s=5.0)
        self.poll()
        self._process.close()


def _nan_for_null(line: bytes) -> bytes:
    """JSON has no NaN: msgspec writes null for it; a report without the field has NaN again."""
    pairs: dict[str, Any] = msgspec.json.decode(line)
    return msgspec.json.encode({key: value for key, value in pairs.items() if value is not None})


class GoalStatus(msgspec.Struct, frozen=True):
    """What became of a goal: `at_s` of simulated time it was reached, `None` when it was not."""

    deformable: str
    goal: str
    at_s: float | None


class DemoResult(msgspec.Struct, frozen=True):
    """What `demo NAME --json` prints. `alignment_mm`, by person: stated p95 and true error at the sheet; nobody who
    never was aligned."""

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


def run_demo(
    play: Play,
    config: SessionConfig,
    timeout_s: float = 90.0,
    on_session: Callable[[Session], AbstractContextManager[Callable[[], object]]] | None = None,
    profile: str = "",
    seed: int = 0,
) -> DemoResult:
    """Runs `play` to its end. `on_session`: a context around the running session; gives what its loop calls always.

    `profile`: every process of people joins over a bad link like this, with the weather of `seed`; empty: directly.
    """
    session = Session(
        play.model, config=dataclasses.replace(config, anchors=play.anchors, anchor_sizes=play.anchor_sizes)
    )
    judge = _Judge(play, session)
    with ExitStack() as stack:
        stack.enter_context(session.signals())
        stack.enter_context(session)
        update = stack.enter_context(on_session(session)) if on_session is not None else (lambda: None)
        groups = _groups(play.people)
        links = {link_address(i): profile for i in range(len(groups))} if profile else {}
        if links:
            ports = session.processes.front_ports
            stack.enter_context(ImpairmentProcess(links, ports.for_clients, target=ports.host, seed=seed))
        addresses = [f"{link}:{session.processes.front_ports.control}" for link in links] or [session.address] * len(
            groups
        )
        people = stack.enter_context(_People(addresses, groups, timeout_s))
        next_read_ns = began_ns = 0

        def finished() -> bool:
            nonlocal next_read_ns, began_ns
            update()
            now_ns = session.clock()
            began_ns = began_ns or now_ns  # making the loop ready is no part of its pace
            judge.look()
            if now_ns < next_read_ns:
                return False
            next_read_ns = now_ns + READ_PERIOD_NS
            return people.finished() and judge.settled()

        session.run(seconds=timeout_s + 5.0, until=finished)
        run_s = max(session.clock() - began_ns, 1) * 1e-9
        people.close()
        interrupted = session.stopping
        status = session.status()
        seconds = session.clock() * 1e-9
        recording = session.recording
    reports = people.reports
    # Ctrl-C asks for an end now; `iris-session verify` has all the time it needs.
    verified, verification = (None, "not verified: interrupted") if interrupted else _verify(recording)
    problems = ["interrupted before its end"] if interrupted else _problems(play, reports, status, timeout_s)
    if not interrupted:
        problems += judge.problems()
    if verified is False:
        problems.append(verification)
    return DemoResult(
        ok=not problems and len(reports) == len(play.people),
        demo=play.name,
        seconds=round(seconds, 3),
        participants=tuple(sorted(reports)),
        handovers=status.handovers,
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
        real_time_factor=round(status.sim_time / run_s, 3),
        state_age_ms_p99={name: round(r.age_ms_p99, 2) for name, r in reports.items() if math.isfinite(r.age_ms_p99)},
        problems=tuple(problems),
        notes=play.notes,
        interrupted=interrupted,
        goals=judge.status(),
    )


class _Judge:
    """Follows the goals of a play, tick by tick, and has the verdict recorded as that of an episode."""

    def __init__(self, play: Play, session: Session) -> None:
        self._name = play.name
        self._session = session
        self._watches = tuple(GoalWatch(goal) for goal in play.goals)
        self._began = False
        self._finished_s: float | None = None

    def look(self) -> None:
        """After every tick."""
        if not self._watches:
            return
        if not self._began:
            self._began = True
            self._session.post(Episode(0, EpisodeAction.START, self._name))
        world = self._session.stepper.core.world
        now_s, reached = world.view().sim_time, False
        for watch in self._watches:
            name = watch.goal.deformable
            reached |= watch.observe(now_s, world.flexes.read_vertices(name), world.flexes.find_touching_robots(name))
        if reached and all(watch.at_s is not None for watch in self._watches):
            self._session.post(Episode(0, EpisodeAction.SUCCESS, self._name))

    def settled(self) -> bool:
        """Asked when everybody is done: whether the goals are reached, or evidently will not be."""
        now_s = self._session.clock() * 1e-9
        self._finished_s = now_s if self._finished_s is None else self._finished_s
        return all(watch.at_s is not None for watch in self._watches) or now_s - self._finished_s > SETTLE_S

    def status(self) -> tuple[GoalStatus, ...]:
        return tuple(
            GoalStatus(w.goal.deformable, w.goal.name, None if w.at_s is None else round(w.at_s, 3))
            for w in self._watches
        )

    def problems(self) -> list[str]:
        """The goals that were not reached."""
        return [
            f"the {w.goal.deformable} was not {w.goal.name}, let go and at rest"
            for w in self._watches
            if w.at_s is None
        ]


def _groups(specs: Sequence[HeadsetSpec]) -> list[Sequence[HeadsetSpec]]:
    """Who shares a process: nobody as long as two people work, else see `WORKERS_PER_PROCESS`."""
    workers = [spec for spec in specs if not spec.observer]
    observers = [spec for spec in specs if spec.observer]
    each = 1 if len(workers) <= 2 else WORKERS_PER_PROCESS
    groups: list[Sequence[HeadsetSpec]] = [workers[i : i + each] for i in range(0, len(workers), each)]
    return groups + [observers[i : i + OBSERVERS_PER_PROCESS] for i in range(0, len(observers), OBSERVERS_PER_PROCESS)]


class _People:
    """The emulated people of a demo, in processes of their own."""

    def __init__(self, addresses: Sequence[str], groups: Sequence[Sequence[HeadsetSpec]], timeout_s: float) -> None:
        self._workers: list[EmulatorProcess] = []
        self._observers: list[EmulatorProcess] = []
        try:
            for address, group in zip(addresses, groups, strict=True):
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
        """The newest report of everybody, by name."""
        return {name: r for process in (*self._workers, *self._observers) for name, r in process.reports.items()}

    def finished(self) -> bool:
        """Reads the reports; whether everybody whose task has an end has come to it."""
        for process in (*self._workers, *self._observers):
            process.poll()
        return not any(process.running and process.busy for process in self._workers)

    def close(self) -> None:
        for process in (*self._workers, *self._observers):
            process.close()


def _problems(play: Play, reports: dict[str, HeadsetReport], status: SessionStatus, timeout_s: float) -> list[str]:
    """Why this was no success; empty when it was one."""
    tasks = {spec.name: spec for spec in play.people}
    problems = [f"{name}: {report.failed}" for name, report in reports.items() if report.failed]
    problems += [
        f"{name}: not done within {timeout_s:g} s, at '{r.phase}'"
        for name, r in reports.items()
        if not (r.done or r.failed or tasks[name].endless)
    ]
    given = {handover.object for handover in status.handovers}
    problems += [
        f"the detector saw no handover of the {thing} by contact alone" for thing in play.objects if thing not in given
    ]
    return problems


def _verify(recording: Path | None) -> tuple[bool | None, str]:
    if recording is None:
        return None, "not recorded"
    report = verify_recording(recording)
    return report.ok, report.line()
