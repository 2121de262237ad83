"""Soak test: operators over bad links are disconnected, killed, and lose their robots at random; nothing may leak.

    python tools/soak.py --seconds 3600 --operators 8 --observers 4 --profile busy-wifi --json
    python tools/soak.py --seconds 60 --operators 3 --observers 1

Runs a session (`iris-session serve`, recorded, mode takeover) with seven-joint arms, emulated operators in processes
of their own behind the impairment proxy, and disturbances at random times from `--seed`. Checked at the end:

- every operator is connected and drives, within a minute of the last disturbance;
- every client received every event without a gap after each of its snapshots, equal to those of the recording;
- the memory of authority, front and recorder does not grow in the second half;
- `iris-session verify` finds every step identical.

Prints the result as text or one JSON object; exit status 0 if all checks hold, else `problems` lists the failures.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import psutil
from soak_worker import RECORD, Job, fingerprint

from iris_session.client import Client, ClientError
from iris_session.demo.scenes import n_arms_scene
from iris_session.demo.scenes.generators import arm_names
from iris_session.emulator.specs import OBSERVER, HeadsetSpec
from iris_session.netsim.process import ImpairmentProcess
from iris_session.netsim.profiles import load_profile
from iris_session.protocol.client_messages import Acquire, Release
from iris_session.protocol.common import Target
from iris_session.protocol.server_messages import Event, MarkerAdded
from iris_session.recording import Recording

COMMAND: Final = [sys.executable, "-m", "iris_session.cli.main"]
#: Relative frequency of disturbances.
KINDS: Final = {"kill": 3, "leave": 1, "cut": 3, "reset": 3, "stall": 3, "roam": 2, "freeze": 2, "takeover": 6}
EVERY_S: Final = 1.5  # mean time between two of them
LONGEST_S: Final = 4.0  # of a stall or a frozen process
RECOVER_S: Final = 60.0
START_S: Final = 90.0
PROGRESS_EVERY_S: Final = 60.0
END: Final = "end of the soak"


@dataclass
class Worker:
    """One process of operators and its link. `undo`: time and kind of the end of its disturbance."""

    number: int
    link: str
    specs: tuple[HeadsetSpec, ...]
    process: subprocess.Popen[bytes] | None = None
    lives: int = 0
    undo: tuple[float, str] | None = None


@dataclass
class Result:
    problems: list[str] = field(default_factory=list)
    disturbances: Counter[str] = field(default_factory=Counter)
    rss: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


class Soak:
    """One run of the soak test. `folder`: of recording, logs and identities."""

    def __init__(self, options: argparse.Namespace, folder: Path, stack: ExitStack) -> None:
        self.options, self.folder, self.stack = options, folder, stack
        self.random = random.Random(options.seed)
        self.result = Result()
        self.events: list[Event] = []
        self.recording = folder / "session.rrd"
        self._next_sample_s = 0.0
        self._taken_robots: list[tuple[float, str]] = []
        self._sources = 0

    # --- start --------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start session, director, proxy and operators. Raise `SystemExit` if the session does not listen."""
        scene = self.folder / "arms.xml"
        spec = n_arms_scene(self.options.operators)
        spec.compile()
        scene.write_text(spec.to_xml())
        ports = ["--control-port", "0", "--state-port", "0", "--mode", "takeover"]
        self.server = subprocess.Popen(
            [*COMMAND, "serve", str(scene), *ports, "--record", str(self.recording), "--json"],
            stdout=self._log("serve.json"),
            stderr=self._log("serve.out"),
        )
        self.stack.callback(self._end_server)
        listening = self._wait(lambda: re.search(r" on (\S+):(\d+),", self._read("serve.out")), "the session listens")
        host, port = listening[1], int(listening[2])
        self.director = self._join(f"{host}:{port}", "director")
        self.thief = self._join(f"{host}:{port}", "operator")
        welcome = self.director.connection.welcome
        assert welcome is not None
        self.workers = self._workers()
        self.proxy = self.stack.enter_context(
            ImpairmentProcess(
                dict.fromkeys((w.link for w in self.workers), self.options.profile),
                [port, welcome.endpoints.state],
                target=host,
                seed=self.options.seed,
            )
        )
        self.port = port
        for worker in self.workers:
            self.stack.callback(self._kill, worker)
            self._spawn(worker)
        self._run_until(self._is_everyone_driving, START_S, "every operator drives at the beginning")

    def _join(self, address: str, role: str) -> Client:
        client = Client(address, role=role, name=f"soak-{role}", alignment="not_needed")
        if role == "director":
            client.on_event = self.events.append
        self.stack.callback(client.close)
        return client.connect(30.0)

    def _workers(self) -> list[Worker]:
        options = self.options
        made: list[Worker] = []
        arms = arm_names(options.operators)
        behaviours = [("wander", f"operator{i}", arms[i]) for i in range(options.operators)]
        behaviours += [(OBSERVER, f"observer{i}", "") for i in range(options.observers)]
        specs = [
            HeadsetSpec(
                name=name,
                behaviour=behaviour,
                robot=robot,
                seed=options.seed + i,
                viewpoints=4,
                phase_timeout_s=1e6,
                identity_file=str(self.folder / f"{name}.identity"),
            )
            for i, (behaviour, name, robot) in enumerate(behaviours)
        ]
        for i in range(0, len(specs), options.per_process):
            number = len(made)
            made.append(Worker(number, f"127.0.1.{number + 1}", tuple(specs[i : i + options.per_process])))
        return made

    def _spawn(self, worker: Worker) -> None:
        worker.lives += 1
        job = Job(
            f"{worker.link}:{self.port}", worker.specs, str(self.folder / f"worker{worker.number}-{worker.lives}")
        )
        worker.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("soak_worker.py"))],
            stdin=subprocess.PIPE,
            stdout=self._log(f"worker{worker.number}.out"),
            stderr=subprocess.STDOUT,
        )
        assert worker.process.stdin is not None
        worker.process.stdin.write(msgspec.json.encode(job))
        worker.process.stdin.close()

    # --- the run ------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Disturb until the time is over, then wait for recovery."""
        begun = due = reported = time.monotonic()
        end = begun + self.options.seconds
        while (now := time.monotonic()) < end:
            self._poll()
            self._undo(now)
            if now - reported >= PROGRESS_EVERY_S:
                reported = now
                self._print_progress(now - begun)
            if now >= due:
                due = now + self.random.expovariate(1.0 / EVERY_S)
                kind = self.random.choices(list(KINDS), list(KINDS.values()))[0]
                self._disturb(kind, now)
        self._undo(float("inf"))
        self.proxy.execute("profile good-wifi")
        if self._run_until(self._is_everyone_driving, RECOVER_S, "every operator drives again at the end"):
            self.director.marker(END)
            self._run_until(self._has_everyone_last_event, RECOVER_S, "every client has the last event")

    def _print_progress(self, seconds: float) -> None:
        """Print the progress of the run."""
        memory = ", ".join(f"{name} {rows[-1][1]:.0f} MiB" for name, rows in self.result.rss.items())
        done = f"{seconds / 60.0:.0f} of {self.options.seconds / 60.0:.0f} min"
        many = f"{self.result.disturbances.total()} disturbances, {len(self.result.problems)} problems"
        print(f"{done}: {many}; {memory}", file=sys.stderr, flush=True)

    def _disturb(self, kind: str, now: float) -> None:
        worker = self.random.choice(self.workers)
        if worker.undo is not None or worker.process is None:
            return
        self.result.disturbances[kind] += 1
        seconds = self.random.uniform(0.2, LONGEST_S)
        if kind in ("kill", "leave"):
            worker.process.send_signal(signal.SIGKILL if kind == "kill" else signal.SIGTERM)
            worker.process.wait(20.0)
            worker.process = None
            worker.undo = (now + seconds, "spawn")
        elif kind in ("cut", "reset"):
            self.proxy.execute(f"{kind} @{worker.link}")
        elif kind == "roam":
            self._sources = self._sources % 250 + 1
            self.proxy.execute(f"roam 127.0.2.{self._sources} @{worker.link}")
        elif kind == "stall":
            self.proxy.execute(f"stall @{worker.link}")
            worker.undo = (now + seconds, "resume")
        elif kind == "freeze":
            worker.process.send_signal(signal.SIGSTOP)
            worker.undo = (now + seconds, "thaw")
        else:
            robot = self.random.choice(arm_names(self.options.operators))
            self._ask(Acquire(0, (robot,)))
            self._taken_robots.append((now + self.random.uniform(0.2, 2.0), robot))

    def _undo(self, now: float) -> None:
        """End disturbances that are over: restart killed processes, continue stopped ones."""
        for worker in self.workers:
            if worker.undo is None or worker.undo[0] > now:
                continue
            what, worker.undo = worker.undo[1], None
            if what == "spawn":
                self._spawn(worker)
            elif what == "resume":
                self.proxy.execute(f"resume @{worker.link}")
            elif worker.process is not None:
                worker.process.send_signal(signal.SIGCONT)
        for item in [item for item in self._taken_robots if item[0] <= now]:
            self._taken_robots.remove(item)
            lease_version = self.thief.lease_version(item[1])
            if lease_version is not None:
                self._ask(Release(0, (Target(item[1], lease_version),)))

    def _ask(self, message: Acquire | Release) -> None:
        if self.thief.ready:
            self.thief.submit(message)

    def _poll(self) -> None:
        """Poll our own clients; once a second, check the processes and record their memory."""
        self.director.poll(0.01)
        self.thief.poll(0.0)
        now = time.monotonic()
        if now < self._next_sample_s:
            return
        self._next_sample_s = now + 1.0
        if self.server.poll() is not None:
            raise SystemExit(f"the session ended: {self._read('serve.out')[-2000:]}")
        for worker in self.workers:
            if worker.process is not None and worker.process.poll() is not None:
                self._problem(f"worker {worker.number} ended with status {worker.process.returncode}")
                worker.process, worker.undo = None, (now, "spawn")
        for process in (psutil.Process(self.server.pid), *psutil.Process(self.server.pid).children()):
            line = " ".join(process.cmdline())
            name = "front" if "front.main" in line else "recorder" if "recording.process" in line else "authority"
            if name == "authority" and process.pid != self.server.pid:
                continue  # the live view and other helpers
            self.result.rss.setdefault(name, []).append((now, process.memory_info().rss / 2**20))

    def _is_everyone_driving(self) -> bool:
        mirror, state = self.director.mirror, self.director.scene.state
        if state is None:
            return False
        connected = {p.name: p.id for p in mirror.participants.values() if p.connected}
        names = {spec.name for worker in self.workers for spec in worker.specs}
        if not names <= set(connected):
            return False
        fresh = {
            a.robot: a.participant for a in state.header.applied if state.header.session_time - a.step_ns < 500_000_000
        }
        mine = {s.robot: connected[s.name] for worker in self.workers for s in worker.specs if s.robot}
        return all(fresh.get(robot) == holder for robot, holder in mine.items())

    def _has_everyone_last_event(self) -> bool:
        ends = [e.event_seq for e in self.events if isinstance(e.body, MarkerAdded) and e.body.text == END]
        return bool(ends) and all(
            self._event_seq(worker, spec.name) >= ends[0] for worker in self.workers for spec in worker.specs
        )

    def _event_seq(self, worker: Worker, name: str) -> int:
        try:
            return int(json.loads(self._read(f"worker{worker.number}-{worker.lives}-{name}.json"))["event_seq"])
        except ValueError:
            return 0

    def _run_until(self, condition: Callable[[], bool], seconds: float, what: str) -> bool:
        """Wait for a condition. If it does not hold in time, record a problem and return False."""
        deadline = time.monotonic() + seconds
        while not condition():
            self._poll()
            if time.monotonic() > deadline:
                connected = sorted(p.name for p in self.director.mirror.participants.values() if p.connected)
                self._problem(f"not within {seconds:g} s: {what}; connected: {', '.join(connected)}")
                return False
        return True

    # --- the end ------------------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """Stop everything, then check events, memory and the recording."""
        result = self.result
        for worker in self.workers:
            if worker.process is not None:
                worker.process.send_signal(signal.SIGTERM)
        for worker in self.workers:
            if worker.process is not None and worker.process.wait(20.0) != 0:
                self._problem(f"worker {worker.number} ended with status {worker.process.returncode}")
        result.details["proxy"] = self.proxy.execute("stats")["links"]
        self.server.send_signal(signal.SIGINT)
        if self.server.wait(60.0) != 0:
            self._problem(f"the session ended with status {self.server.returncode}")
        status = json.loads(self._read("serve.json") or "{}")
        result.details["late_tick_share"] = status.get("lateness", {}).get("late_share")
        result.details["session_drops"] = status.get("drops")
        result.details["restarts"] = status.get("restarts")
        if any((status.get("restarts") or {}).values()):
            self._problem(f"processes were replaced: {status['restarts']}")
        verified = subprocess.run(
            [*COMMAND, "verify", "--json", str(self.recording)], capture_output=True, text=True, check=False
        )
        result.details["verified"] = verified.returncode == 0
        if verified.returncode != 0:
            self._problem(f"verify: {(verified.stdout + verified.stderr)[-1000:]}")
        events, problems = check_events(self.recording, self.folder)
        result.details["events"] = events
        (self.folder / "rss.json").write_text(json.dumps(result.rss))
        memory, growing = check_memory(result.rss)
        result.details["memory"] = memory
        result.problems += problems + growing
        for worker in self.workers:
            for spec in worker.specs:
                report = self._read(f"worker{worker.number}-{worker.lives}-{spec.name}.json")
                if report and json.loads(report)["failed"]:
                    self._problem(f"{spec.name} failed: {json.loads(report)['failed']}")

    def _problem(self, text: str) -> None:
        self.result.problems.append(text)
        print(f"problem: {text}", file=sys.stderr, flush=True)

    def _kill(self, worker: Worker) -> None:
        if worker.process is not None and worker.process.poll() is None:
            worker.process.kill()
            worker.process.wait()

    def _end_server(self) -> None:
        if self.server.poll() is None:
            children = psutil.Process(self.server.pid).children(recursive=True)
            self.server.kill()
            self.server.wait()
            psutil.wait_procs(children, 10.0)

    def _log(self, name: str) -> int:
        return self.stack.enter_context((self.folder / name).open("ab")).fileno()

    def _read(self, name: str) -> str:
        path = self.folder / name
        return path.read_text(errors="replace") if path.exists() else ""

    def _wait(self, condition: Callable[[], Any], what: str) -> Any:
        deadline = time.monotonic() + 30.0
        while not (found := condition()):
            if time.monotonic() > deadline or self.server.poll() is not None:
                raise SystemExit(f"not within 30 s: {what}\n{self._read('serve.out')}")
            time.sleep(0.05)
        return found


# --- checks -----------------------------------------------------------------------------------------------------------


#: Growth in the second half that is noise: allocators, caches that fill.
NOISE_MIB: Final = 6.0


def check_events(recording: Path, folder: Path) -> tuple[dict[str, int], list[str]]:
    """Compare the logs `*.events` in `folder` with the recording. Return counts, and a line per problem."""
    problems: list[str] = []
    with Recording.open(recording) as opened:
        recorded = {event.event_seq: fingerprint(event) for event in opened.events()}
    if list(recorded) != list(range(1, len(recorded) + 1)):
        problems.append(f"the recording's {len(recorded)} events are not numbered without a gap")
    logs = sorted(folder.glob("*.events"))
    handed = filled = 0
    for log in logs:
        data = log.read_bytes()
        whole = len(data) - len(data) % RECORD.size  # a killed process may leave half a record
        handed += whole // RECORD.size
        gaps, problem = check_log(log.name, list(struct.iter_unpack(RECORD.format, data[:whole])), recorded)
        filled += gaps
        problems += problem
    return {"recorded": len(recorded), "logs": len(logs), "handed_out": handed, "filled_by_snapshots": filled}, problems


def check_log(name: str, records: list[tuple[Any, ...]], recorded: dict[int, int]) -> tuple[int, list[str]]:
    """Check the events of one client.

    All must be in order and as recorded, and none may be missing without a notification. A client whose link is blocked
    loses events and receives a snapshot instead.

    Args:
        name: Name of the log.
        records: Connection generation, number of notifications of missed events so far, `event_seq`, CRC.
        recorded: CRC by `event_seq` in the recording.

    Returns:
        The number of gaps that a snapshot filled on a connection that continued, and a line per problem.
    """
    last_generation = last_notified = last_seq = -1
    filled = 0
    for generation, notified, seq, crc in records:
        if last_seq >= 0 and seq != last_seq + 1:
            if notified == last_notified:
                return filled, [f"{name}: event {seq} came after {last_seq}, without a notification of those between"]
            filled += generation == last_generation
        if seq <= last_seq:
            return filled, [f"{name}: event {seq} came after {last_seq}"]
        if recorded.get(seq) != crc:
            return filled, [f"{name}: event {seq} is not that of the recording"]
        last_generation, last_notified, last_seq = generation, notified, seq
    return filled, []


def check_memory(rss: dict[str, list[tuple[float, float]]]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Return resident memory per process over the second half of the run [MiB]: start, end, growth per hour.

    Growth is that of the lowest value, from the third quarter to the last. Above it memory comes and goes with the
    load, by 10 MiB in the recorder, and is highest at the end, when all operators drive.
    """
    figures: dict[str, dict[str, float]] = {}
    problems: list[str] = []
    for name, series in rss.items():
        half = np.array(series[len(series) // 2 :])
        if len(half) < 4:
            continue
        third, last = half[: len(half) // 2], half[len(half) // 2 :]
        slope = float((last[:, 1].min() - third[:, 1].min()) / (last[0, 0] - third[0, 0]))
        growth = slope * float(half[-1, 0] - half[0, 0])
        figures[name] = {
            "mib": round(float(half[-1, 1]), 1),
            "mib_at_half": round(float(half[0, 1]), 1),
            "mib_per_hour": round(slope * 3600.0, 1),
        }
        if growth > NOISE_MIB:
            problems.append(
                f"memory of {name} grew by {growth:.1f} MiB in the second half, allowed are {NOISE_MIB:g} MiB"
            )
    return figures, problems


# --- command ----------------------------------------------------------------------------------------------------------


def soak(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run the soak test in `folder`. Return the object that `--json` prints."""
    load_profile(options.profile)
    begun = time.monotonic()
    with ExitStack() as stack:
        run = Soak(options, folder, stack)
        run.start()
        run.run()
        run.finish()
    return {
        "ok": not run.result.problems,
        "seconds": round(time.monotonic() - begun, 1),
        **{k: getattr(options, k) for k in ("operators", "observers", "per_process", "profile", "seed")},
        "disturbances": dict(run.result.disturbances),
        **run.result.details,
        "problems": run.result.problems,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0, help="duration of disturbances (%(default)s)")
    parser.add_argument("--operators", type=int, default=8)
    parser.add_argument("--observers", type=int, default=4)
    parser.add_argument("--per-process", type=int, default=2, help="operators per process and link (%(default)s)")
    parser.add_argument(
        "--profile", default="busy-wifi", help="profile of every link: docs/evidence/links.md (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of disturbances, operators and links")
    parser.add_argument("--keep", type=Path, help="folder for recording and logs (default: a temporary one)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ended by another program: the children end, too
    folder = options.keep or Path(tempfile.mkdtemp(prefix="iris-soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        result = soak(options, folder)
    except ClientError as error:
        raise SystemExit(f"soak: {error}") from error
    finally:
        if options.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps(result) if options.json else "\n".join(f"{key:<16}{value}" for key, value in result.items()))
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
