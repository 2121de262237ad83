"""Harness of the session benchmarks: a session in this process, clients in other processes, one measured window.

Clients join directly, or over an impaired link: then the impairment proxy of `netsim` runs in a process of its own.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import mujoco
import numpy as np
import psutil
from numpy.typing import NDArray

from iris_session.authority.config import UNALIGNED, AuthorityConfig
from iris_session.bench.clients import BROWSERS, TABS, ClientJob, Job, make_web_secret
from iris_session.bench.plugins import PluginProcess
from iris_session.bench.report import BenchError, compute_percentile
from iris_session.netsim.process import ImpairmentProcess, make_link_address
from iris_session.physics import PacerStats
from iris_session.protocol.client_messages import EStop, Sample
from iris_session.protocol.entries import Entry
from iris_session.protocol.names import Role
from iris_session.security import WEB, KeyHome, KeyPair, encode_key
from iris_session.session.config import SessionConfig
from iris_session.session.session import Session
from iris_session.session.status import SessionStatus

Log = dict[str, NDArray[Any]]
STALL_S: Final = 3.0
LEAD_S: Final = 0.5  # from the beginning of an interval to the stall
#: Shortest interval with a stall: the lead, the stall, and a second to recover.
SHORTEST_STALL_S: Final = LEAD_S + STALL_S + 1.0
#: Kind of intervals in which nothing is disturbed.
BASELINE: Final = "baseline"
#: A frame is fresh if it is at most this much older than the median of the client before the stall.
FRESH_MS: Final = 20.0


class Interval(NamedTuple):
    """A part of the window, in seconds from its beginning."""

    kind: str
    begin_s: float
    end_s: float

    @property
    def stall_s(self) -> float:
        return self.begin_s + LEAD_S

    @property
    def resume_s(self) -> float:
        return self.stall_s + STALL_S

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s


def plan_rounds(lengths_s: Mapping[str, float], seconds: float, rounds: int, lead_s: float = 0.0) -> list[Interval]:
    """Return rounds of intervals that fill the seconds after the lead: as many as fit, 1 to `rounds`.

    `lengths_s`: the shortest length of an interval by its kind.
    """
    round_s = sum(lengths_s.values())
    rounds = max(1, min(rounds, int((seconds - lead_s) / round_s)))
    stretch = max(1.0, (seconds - lead_s) / (rounds * round_s))
    times_s = [round(lead_s + stretch * s, 6) for s in accumulate(list(lengths_s.values()) * rounds, initial=0.0)]
    return [Interval(*one) for one in zip(list(lengths_s) * rounds, times_s[:-1], times_s[1:], strict=True)]


def select_between(times_ns: NDArray[Any], begin_ns: int, from_s: float, to_s: float) -> NDArray[np.bool_]:
    """Return which session times lie between two times [s] of a window that begins at `begin_ns`."""
    return np.asarray((times_ns - begin_ns >= from_s * 1e9) & (times_ns - begin_ns < to_s * 1e9))


def compute_ages_ms(logs: Iterable[Log]) -> NDArray[np.float64]:
    """Return the ages of all states when they were handed to applications [ms]."""
    return np.concatenate([(log["handed_ns"] - log["state_ns"]) * 1e-6 for log in logs])


def compute_age_p99_ms(logs: Sequence[Log], begin_ns: int, from_s: float, to_s: float) -> float:
    """Return the 99th percentile of the ages between two times of a window [ms], infinite where no state came."""
    is_between = [select_between(log["handed_ns"], begin_ns, from_s, to_s) for log in logs]
    return compute_percentile(compute_ages_ms(logs)[np.concatenate(is_between)], 99)


def measure_after_stall(log: Log, begin_ns: int, interval: Interval, resumed_ns: int) -> tuple[float, float]:
    """Return the age of the first frame after the stall, and the time from its end to the first fresh frame [ms].

    Infinite if no frame arrived within the interval.
    """
    handed, ages = log["handed_ns"], log["handed_ns"] - log["state_ns"]
    before = select_between(handed, begin_ns, interval.begin_s, interval.stall_s)
    usual_ns = float(np.median(ages[before])) if before.any() else 0.0
    after = (handed >= resumed_ns) & (handed < begin_ns + interval.end_s * 1e9)
    if not after.any():
        return float("inf"), float("inf")
    fresh = after & (ages <= usual_ns + FRESH_MS * 1e6)
    first_ms = float(ages[after][0]) * 1e-6
    return first_ms, float(handed[fresh][0] - resumed_ns) * 1e-6 if fresh.any() else float("inf")


def summarize_stalls(
    log: Log, begin_ns: int, resumed: dict[Interval, int], kind: str, prefix: str = ""
) -> dict[str, float]:
    """Return the worst of `measure_after_stall` over the stalls of a kind. `resumed`: session times of their ends."""
    after = [measure_after_stall(log, begin_ns, one, at_ns) for one, at_ns in resumed.items() if one.kind == kind]
    names = ("resume_first_age_ms", "resume_fresh_after_ms")
    return {f"{prefix}{name}": round(max(v), 3) for name, v in zip(names, zip(*after, strict=True), strict=True)}


def summarize_runs(key: str, values: Sequence[float]) -> dict[str, Any]:
    """Return the median of the runs of a kind of interval, and the runs by number."""
    runs = {str(i + 1): round(value, 3) for i, value in enumerate(values)}
    return {key: round(float(np.median(values)), 3), f"{key}_runs": runs}


# --- sessions with clients --------------------------------------------------------------------------------------------


#: The bars are stated for at most four clients in one process.
CLIENTS_PER_PROCESS: Final = 4
WARM_UP_S: Final = 3.0
#: Time in which clients have joined, and in which they have written their logs after the window [s].
JOIN_S: Final = 60.0
EXIT_S: Final = 60.0
#: Period of asking client processes whether they have answered.
ASK_NS: Final = 50_000_000
#: Time in which client processes leave the session [s].
LEAVE_S: Final = 5.0


def _group_clients(clients: Sequence[ClientJob]) -> list[list[ClientJob]]:
    """Return the clients of each process: at most `CLIENTS_PER_PROCESS` of one plug-in."""
    groups: list[list[ClientJob]] = []
    for _, own in groupby(clients, lambda one: (one.plugin, one.alone and one.name)):
        together = list(own)
        groups += [together[i : i + CLIENTS_PER_PROCESS] for i in range(0, len(together), CLIENTS_PER_PROCESS)]
    return groups


class Usage(NamedTuple):
    """Use of the machine by a session in a window.

    `cpu_shares`: of one core, of `server` (authority and front), `recorder` and `gateway`, where they ran at both ends;
    `rss`: their memory at both ends [bytes]. `late_causes`: late ticks of the last ten seconds by cause.
    """

    stats: PacerStats
    late_causes: dict[str, int]
    cpu_shares: dict[str, float]
    rss: dict[str, tuple[int, int]]


#: Ticks, and by process its processor time [s] and memory [bytes], at one time.
_Reading = tuple[PacerStats | None, dict[str, tuple[float, int]]]


def _read_usage(session: Session, *, anew: bool) -> _Reading:
    processes = session.processes
    pids = {
        "server": (os.getpid(), processes.front_pid),
        "recorder": (0 if processes.recorder is None else processes.recorder.pid,),
        "gateway": (0 if processes.web is None else processes.web.pid,),
    }
    found = {}
    for name, own in pids.items():
        if all(own):
            times, memory = zip(*((p.cpu_times(), p.memory_info()) for p in map(psutil.Process, own)), strict=True)
            found[name] = (sum(one.user + one.system for one in times), sum(one.rss for one in memory))
    return session.lateness(anew=anew), found


def _compute_usage(session: Session, begin: _Reading, end: _Reading, seconds: float) -> Usage:
    before, after, times = begin[0], end[0], session.processes.reporter.times
    assert before is not None
    assert after is not None
    ticks, late = after.ticks - before.ticks, after.late - before.late
    stats = after._replace(
        ticks=ticks, finished=after.finished - before.finished, late=late, late_share=late / max(1, ticks)
    )
    both = {name: (begin[1][name], end[1][name]) for name in begin[1].keys() & end[1].keys()}
    return Usage(
        stats,
        {} if times is None else times.count_late_causes(),
        {name: (last[0] - first[0]) / seconds for name, (first, last) in both.items()},
        {name: (first[1], last[1]) for name, (first, last) in both.items()},
    )


class Measurement(NamedTuple):
    """Measurements of one window.

    Attributes:
        seconds: Length of the window.
        begin_ns: Session time of its beginning.
        logs: Logs by client name.
        usage: What the session used of the machine.
        truth: Poses by tick in the authority.
        received: Sequence number and session time of receipt of samples, by connection and device.
        stops: Session time at which the front received each e-stop, and at which the step that holds had ended.
        connections: Connection numbers by client name.
        status: Status of the session at the end.
        rejected: Rejected samples by reason.
    """

    seconds: float
    begin_ns: int
    logs: dict[str, Log]
    usage: Usage
    truth: dict[int, NDArray[np.float64]]
    received: dict[tuple[int, str], list[tuple[int, int]]]
    stops: list[tuple[int, int]]
    connections: dict[str, int]
    status: SessionStatus
    rejected: dict[str, int]

    def summarize(self, *keys: str) -> dict[str, Any]:
        """Return some of what is measured of the session itself, under the keys of reports."""
        found = {
            "server_cpu_share": round(self.usage.cpu_shares["server"], 3),
            "late_tick_share": round(self.usage.stats.late_share, 6),
            "lateness_ms_p99": round(self.usage.stats.p99_ns * 1e-6, 3),
            "ticks": self.usage.stats.ticks,
            "frames_not_logged": sum(int(log["counts"][1]) for log in self.logs.values() if "counts" in log),
            "late_causes": self.usage.late_causes,
            "scheduling": self.status.scheduling,
            "drops": self.status.drops,
        }
        return {key: found[key] for key in keys}


class ClientProcess(PluginProcess):
    """Process of one group of clients."""

    def __init__(self, job: Job) -> None:
        self.job = job
        super().__init__(job.clients[0].plugin, job)

    def read_logs(self) -> dict[str, Log]:
        """Return the logs by client name, once the window is over."""
        self.read(EXIT_S)
        with np.load(self.job.log) as columns:
            logs: dict[str, Log] = {}
            for key in columns.files:
                name, column = key.rsplit(".", 1)
                logs.setdefault(name, {})[column] = columns[key]
        return logs


@dataclass
class BenchRun:
    """Running benchmark, on which an action of `measure` acts. `by_client`: processes by client; `links`: addresses."""

    session: Session
    processes: list[ClientProcess]
    by_client: dict[str, ClientProcess]
    links: dict[str, str]
    proxy: ImpairmentProcess | None

    def command_links(self, command: str) -> None:
        """Send a command to the process of the links (`netsim.process`)."""
        assert self.proxy is not None
        self.proxy.send(command)


def make_session_config(
    *, assets: bool | Path = False, record: bool | Path = False, curve: bool = False
) -> SessionConfig:
    """Return the configuration of a measured session. Arguments: as of `measure`."""
    return SessionConfig(
        name="bench",
        control_port=0,
        state_port=0,
        record=record,
        assets=assets,
        # The tracking frames of the emulated operators are the world.
        authority=AuthorityConfig(unaligned=(*UNALIGNED, Role.OPERATOR)),
        curve=curve,
    )


#: Seconds after the beginning of the window, and a function to call then; it must be fast.
Action = tuple[float, Callable[[BenchRun], None]]
#: A function that begins a stall (True) or ends it.
Stall = Callable[[BenchRun, bool], None]


def plan_stalls(plan: Sequence[Interval], stalls: Mapping[str, Stall], resumed: dict[Interval, int]) -> list[Action]:
    """Return the actions that begin and end the stalls of a plan.

    Args:
        plan: Intervals of the window.
        stalls: By kind of interval.
        resumed: Filled with the session time at which each stall ended [ns].
    """

    def switch(run: BenchRun, interval: Interval, begins: bool) -> None:
        if not begins:
            resumed[interval] = run.session.clock()
        stalls[interval.kind](run, begins)

    return [
        (at_s, functools.partial(switch, interval=one, begins=begins))
        for one in plan
        if one.kind in stalls
        for at_s, begins in ((one.stall_s, True), (one.resume_s, False))
    ]


def stop_client(name: str) -> Stall:
    """Return a stall of the process of a client, by SIGSTOP."""
    return lambda run, begins: run.by_client[name].send_signal(signal.SIGSTOP if begins else signal.SIGCONT)


def stall_link(name: str) -> Stall:
    """Return a stall of the link of a client, which passes nothing meanwhile."""
    return lambda run, begins: run.command_links(f"{'stall' if begins else 'resume'} @{run.links[name]}")


def measure(
    model: mujoco.MjModel,
    clients: Sequence[ClientJob],
    seconds: float,
    *,
    seed: int = 0,
    actions: Sequence[Action] = (),
    keep_poses: bool = False,
    curve: bool = False,
    assets: bool | Path = False,
    record: bool | Path = False,
    stream: str = "",
    topology: str = "",
    on_tick: Callable[[Session], None] = lambda _: None,
    progress: Callable[[str], None] = lambda _: None,
) -> Measurement:
    """Run a session with clients and measure `seconds` of it, warm-up excluded.

    Args:
        seed: Random seed of the links.
        actions: Functions to call during the window, in order of their times.
        keep_poses: Keep the true poses of every published tick.
        assets: Store of the scene's assets; False: clients get poses only.
        record: File of the recording; False: none.
        stream: Media stream that clients subscribe to.
        topology: File of its topology.
        on_tick: Called after every tick, warm-up included.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="iris-bench-")))
        people = [spec.name for spec in clients if spec.plugin == BROWSERS]
        keys = stack.enter_context(_open_key_home(folder / "keys", people)) if curve else ()
        config = make_session_config(assets=assets, record=record, curve=curve)
        session = stack.enter_context(Session(model, config=config))
        links = {spec.name: make_link_address(i) for i, spec in enumerate(clients) if spec.profile}
        proxy = None
        if links:
            ports, profiles = session.processes.front_ports, {links[s.name]: s.profile for s in clients if s.profile}
            proxy = stack.enter_context(ImpairmentProcess(profiles, ports.for_clients, target=ports.host, seed=seed))
        run = BenchRun(session, [], {}, links, proxy)
        page = "" if session.processes.web is None else session.processes.web.address
        if any(spec.plugin in (BROWSERS, TABS) for spec in clients) and not page:
            raise BenchError("the session has no page for browsers")
        job = Job(session.address, session.origin_ns, "", (), keep_poses, stream, topology, links=links, keys=keys)
        for group in _group_clients(clients):
            log = str(folder / f"log{len(run.processes)}.npz")
            code = _make_code(session) if group[0].plugin == TABS else ""
            worker = ClientProcess(msgspec.structs.replace(job, log=log, clients=tuple(group), page=page + code))
            stack.callback(worker.close, exit_s=LEAVE_S)
            run.processes.append(worker)
            run.by_client.update((spec.name, worker) for spec in group)
        return _run_session(run, seconds, actions, on_tick, keep_poses, progress)


def _run_session(
    run: BenchRun,
    seconds: float,
    actions: Sequence[Action],
    on_tick: Callable[[Session], None],
    keep_poses: bool,
    progress: Callable[[str], None],
) -> Measurement:
    session, workers = run.session, run.processes
    progress(f"waiting for {len(workers)} client processes")
    if not _run_until_answered(session, workers, JOIN_S):
        raise BenchError(f"the clients did not join within {JOIN_S:g} s")
    for worker in workers:
        worker.read()
    progress(f"warm-up, then measuring {seconds:g} s")
    truth: dict[int, NDArray[np.float64]] = {}
    received: dict[tuple[int, str], list[tuple[int, int]]] = {}
    stops: list[tuple[int, int]] = []
    begin = session.clock() + round(WARM_UP_S * 1e9)
    end = begin + round(seconds * 1e9)

    def store_receipts(entries: Sequence[Entry]) -> None:
        for entry in entries:
            if not begin <= entry.receive_ns < end:
                continue
            if isinstance(entry.message, Sample):
                key = (entry.connection, entry.message.device)
                received.setdefault(key, []).append((entry.message.seq, entry.receive_ns))
            elif isinstance(entry.message, EStop):
                stops.append((entry.receive_ns, session.clock()))

    if keep_poses:
        session.stepper.on_state = lambda header, poses: truth.update({header.tick: poses.copy()})
    session.stepper.on_entries = store_receipts
    view = session.stepper.view
    names = view.names_by_id()
    connections = {names[participant]: number for participant, number in view.connections.items()}
    for worker in workers:
        worker.send("measure", begin, end)
    readings: list[_Reading] = []
    pending = list(actions)
    if run.proxy is not None:  # the times of link profiles count from the beginning of the window
        pending.insert(0, (0.0, lambda run: run.command_links("start")))

    def is_over() -> bool:
        on_tick(session)
        now = session.clock()
        while pending and now >= begin + round(pending[0][0] * 1e9):
            pending.pop(0)[1](run)
        if now >= (end if readings else begin):
            readings.append(_read_usage(session, anew=not readings))
        return len(readings) == 2

    session.run(until=is_over)
    _raise_if_stopped(session)
    if len(readings) < 2:
        raise BenchError("the session ended before the window was over")
    usage = _compute_usage(session, readings[0], readings[1], seconds)
    _run_until_answered(session, workers, EXIT_S)
    return Measurement(
        seconds,
        begin,
        {name: log for worker in workers for name, log in worker.read_logs().items()},
        usage,
        truth,
        received,
        stops,
        connections,
        session.status(),
        {"/".join(key): count for key, count in view.rejected.items()},
    )


def _run_until_answered(session: Session, workers: Sequence[ClientProcess], seconds: float) -> bool:
    """Run the session until every worker has answered its call, at most some seconds. Return whether all have."""
    due_ns = 0

    def until() -> bool:
        nonlocal due_ns
        if session.clock() < due_ns:  # asking must not disturb the measured ticks
            return False
        due_ns = session.clock() + ASK_NS
        return all(one.has_answered() for one in workers)

    session.run(seconds=seconds, until=until)
    _raise_if_stopped(session)
    return all(one.has_answered() for one in workers)


def _raise_if_stopped(session: Session) -> None:
    """Raise `KeyboardInterrupt` if the session was stopped by Ctrl-C: the benchmark has no result then."""
    if session.stopping:
        raise KeyboardInterrupt


@contextlib.contextmanager
def _open_key_home(folder: Path, people: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Use a key home in `folder`, which admits one key for all clients, and browsers by their names.

    Yields:
        The keys of a job.
    """
    home, pair = KeyHome(folder), KeyPair.generate()
    keys = (home.load_server_key().public, pair.public, pair.secret)
    home.clients.allow_key("clients", pair.public)
    for name in people:
        identity = hashlib.sha256(make_web_secret(keys, name)).digest()
        home.clients.allow_key(name, encode_key(identity), kind=WEB)
    before = os.environ.get("IRIS_HOME")
    os.environ["IRIS_HOME"] = str(folder)  # of the session and its processes
    try:
        yield keys
    finally:
        if before is None:
            del os.environ["IRIS_HOME"]
        else:
            os.environ["IRIS_HOME"] = before


def _make_code(session: Session) -> str:
    """Return what follows the address of the page so that a browser pairs; empty without encryption."""
    page = session.processes.web
    if page is None or page.certificate is None:
        return ""
    home = KeyHome()
    code, _ = home.join_codes.create(home.load_server_key(), name="tab", web_key=page.certificate.spki_hash)
    return f"#c={code}"
