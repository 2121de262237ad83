"""The demos: a session in this process, emulated people in others, and a result that says whether it worked.

`handover`: two operators, each with an arm, pass a hammer through the air. It counts only if the session's own detector
saw the object change hands by contact alone, and if the recording verifies bit for bit.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.physics.scenes import scene_path
from iris_session.runtime.config import SessionConfig
from iris_session.runtime.session import Session
from iris_session.runtime.status import HandoverStatus, SessionStatus
from iris_session.runtime.verification import verify_recording

#: How often the reports of the emulated people are read [ns].
READ_PERIOD_NS: Final = 100_000_000
DEMOS: Final = ("handover",)


class EmulatorProcess:
    """Emulated people in a process of their own. `poll()` reads what they report, without waiting."""

    def __init__(self, address: str, specs: Sequence[HeadsetSpec], seconds: float) -> None:
        command = [sys.executable, "-m", "iris_session.emulator", "--address", address, "--specs", "-", "--json"]
        self._process = subprocess.Popen(
            [*command, "--seconds", str(seconds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(msgspec.json.encode(list(specs)))
        self._process.stdin.close()
        self._fd = self._process.stdout.fileno()
        os.set_blocking(self._fd, False)
        self._rest = b""
        self.reports: dict[str, HeadsetReport] = {}

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> None:
        """Takes over the newest report of each person."""
        while True:
            try:
                data = os.read(self._fd, 65536)
            except BlockingIOError:
                return
            if not data:
                return
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                report = msgspec.json.decode(_nan_for_null(line), type=HeadsetReport, strict=False)
                self.reports[report.name] = report

    def close(self) -> None:
        """Ends the process if it still runs, and reads its last words."""
        if self.running:
            self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.poll()
        assert self._process.stdout is not None
        self._process.stdout.close()


def _nan_for_null(line: bytes) -> bytes:
    """JSON has no NaN: msgspec writes null for it; a report without the field has NaN again."""
    pairs: dict[str, Any] = msgspec.json.decode(line)
    return msgspec.json.encode({key: value for key, value in pairs.items() if value is not None})


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
    interrupted: bool = False


def handover_specs(seed: int) -> tuple[HeadsetSpec, HeadsetSpec]:
    """The two operators of the handover demo: they stand on the two sides of the sheet."""
    giver = HeadsetSpec(name="ann", behaviour="giver", robot="left", seed=seed, eye=(-0.35, -0.95, 0.55))
    receiver = HeadsetSpec(name="bob", behaviour="receiver", robot="right", seed=seed + 1, eye=(0.35, -0.95, 0.55))
    return giver, receiver


def run_handover(
    config: SessionConfig,
    seed: int = 0,
    timeout_s: float = 90.0,
    on_session: Callable[[Session], AbstractContextManager[Callable[[], object]]] | None = None,
) -> DemoResult:
    """Runs the handover demo. `on_session`: a context around the running session; gives what its loop calls always."""
    emulators: list[EmulatorProcess] = []
    next_read_ns = 0

    session = Session(scene_path("handover"), config=config)
    with ExitStack() as stack:
        stack.enter_context(session.signals())
        stack.enter_context(session)
        update = stack.enter_context(on_session(session)) if on_session is not None else (lambda: None)

        def finished() -> bool:
            nonlocal next_read_ns
            update()
            now_ns = session.clock()
            if now_ns < next_read_ns:
                return False
            next_read_ns = now_ns + READ_PERIOD_NS
            for emulator in emulators:
                emulator.poll()
            return not any(emulator.running for emulator in emulators)

        try:
            for spec in handover_specs(seed):
                emulators.append(EmulatorProcess(session.address, [spec], timeout_s))
            session.run(seconds=timeout_s + 5.0, until=finished)
        finally:
            for emulator in emulators:
                emulator.close()
        interrupted = session.stopping
        status = session.status()
        seconds = session.clock() * 1e-9
        recording = session.recording
    reports = {name: report for emulator in emulators for name, report in emulator.reports.items()}
    # Ctrl-C asks for an end now; `iris-session verify` has all the time it needs.
    verified, verification = (None, "not verified: interrupted") if interrupted else _verify(recording)
    problems = ["interrupted before its end"] if interrupted else _problems(reports, status, timeout_s)
    if verified is False:
        problems.append(verification)
    return DemoResult(
        ok=not problems and len(reports) == 2,
        demo="handover",
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
        state_age_ms_p99={name: round(r.age_ms_p99, 2) for name, r in reports.items() if math.isfinite(r.age_ms_p99)},
        problems=tuple(problems),
        interrupted=interrupted,
    )


def _problems(reports: dict[str, HeadsetReport], status: SessionStatus, timeout_s: float) -> list[str]:
    """Why this was no handover; empty when it was one."""
    problems = [f"{name}: {report.failed}" for name, report in reports.items() if report.failed]
    problems += [
        f"{name}: not done within {timeout_s:g} s, at '{r.phase}'"
        for name, r in reports.items()
        if not (r.done or r.failed)
    ]
    if not status.handovers:
        problems.append("the detector saw no handover by contact alone")
    return problems


def _verify(recording: Path | None) -> tuple[bool | None, str]:
    if recording is None:
        return None, "not recorded"
    report = verify_recording(recording)
    return report.ok, report.line()
