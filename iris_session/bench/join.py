"""`bench join`: prepare a scene of 300 objects and 200 MB of assets, join and fetch it, and join again with a cache.

Other clients watch the moving scene meanwhile. The age of their state is measured too, and as a reference beside a
program of the same priority that only copies memory.
"""

from __future__ import annotations

import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import msgspec
import mujoco
import numpy as np
import zmq

from iris_session.assets.store import AssetStore
from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import Log, group_clients, measure
from iris_session.bench.join_clients import CopyInterval, JoinJob, JoinResult
from iris_session.bench.join_scene import PreparedScene, make_join_model
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.session.session import Session
from iris_session.system.process import PIPE, ChildProcess, child_environment, module_command

#: Time from the beginning of the window to the join; the baseline of the others is measured first.
BEGIN_S: Final = 4.0
#: Largest share of the bytes that a join with a cache may fetch.
WARM_SHARE: Final = 0.01


def run_join(
    objects: int = 300,
    assets_mb: float = 200.0,
    clients: int = 4,
    seconds: float = 20.0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Join with one client while observers watch.

    Args:
        objects: Number of moving bodies with meshes.
        assets_mb: Size of the assets [MB].
        clients: Number of observers.
        seconds: Length of the measured window.
        seed: Random seed.
        progress: Called with short texts.

    Returns:
        The report. References, in the same run: the same bytes in one message, and the age of the others' state while
        memory is copied at the priority at which a client loads assets.
    """
    progress("compiling the scene")
    model = make_join_model(objects, assets_mb, seed).compile()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="iris-bench-")))
        file = folder / "model.mjb"
        mujoco.mj_saveModel(model, str(file), None)
        store = AssetStore(folder / "store")
        progress("encoding its assets, cache cold")
        cold = _prepare_scene(file, store.root)
        progress("and warm")
        ready = _prepare_scene(file, store.root)
        if ready.built:
            raise BenchError(f"{ready.built} assets were encoded again although the cache is warm")
        paths = [store.path(address) for address in ready.sizes]
        joiner = stack.enter_context(_Joiner(folder, stack.enter_context(_BulkServer(paths)).port))
        got = measure(
            model,
            group_clients([ClientJob(f"client{i}", "observer", samples=True) for i in range(clients)]),
            seconds,
            actions=[(BEGIN_S, lambda _: joiner.start_join())],
            assets=store.root,
            on_tick=joiner.prepare,
            seed=seed,
            progress=progress,
        )
        first, second, copied, bare_s = joiner.read_result()
    results = {
        **_summarize(cold, ready, first, second),
        "others_age_ms_p99": _compute_age_p99_ms(got.logs, first.begin_ns, second.end_ns),
        "others_age_ms_p99_baseline": _compute_age_p99_ms(got.logs, got.begin_ns, first.begin_ns),
        "late_tick_share": round(got.stats.late_share, 6),
        "scheduling": got.scheduling,
        "drops": got.drops,
    }
    params = {"objects": objects, "assets_mb": assets_mb, "clients": clients, "seconds": seconds, "seed": seed}
    reference = {
        "bare_transfer_s": round(bare_s, 3),
        "others_age_ms_p99_memory_copied": _compute_age_p99_ms(got.logs, copied.begin_ns, copied.end_ns),
    }
    return BenchReport("join", params, results, tuple(_make_bars(results, first.bytes)), reference)


def _summarize(cold: PreparedScene, ready: PreparedScene, first: JoinResult, second: JoinResult) -> dict[str, Any]:
    return {
        "ready_s": round(ready.seconds, 3),
        "server_rss_mib": round(ready.rss_mib, 1),
        "first_picture_s": round(first.first_picture_s, 3),
        "complete_s": round(first.complete_s, 3),
        "bytes": first.bytes,
        "warm_complete_s": round(second.complete_s, 3),
        "warm_bytes": second.bytes,
        "assets": first.assets,
        "client_cpu_s": round(first.cpu_s, 3),
        "ready_cold_s": round(cold.seconds, 3),
        "server_rss_cold_mib": round(cold.rss_mib, 1),
    }


def _make_bars(results: dict[str, Any], sent: int) -> list[Any]:
    return [
        make_bar(results, "ready_s", "<=", 2.0),
        make_bar(results, "server_rss_mib", "<=", 150.0),
        make_bar(results, "complete_s", "<=", 1.0),
        make_bar(results, "warm_bytes", "<=", WARM_SHARE * sent),
        make_bar(results, "others_age_ms_p99", "<=", 3.0),
    ]


def _prepare_scene(model: Path, store: Path) -> PreparedScene:
    command = module_command("iris_session.bench.join_scene", str(model), str(store))
    done = subprocess.run(command, stdout=PIPE, env=child_environment(), check=False, process_group=0)
    if done.returncode:
        raise BenchError(f"preparing the scene failed with status {done.returncode}")
    return msgspec.json.decode(done.stdout, type=PreparedScene)


def _compute_age_p99_ms(logs: dict[str, Log], begin_ns: int, end_ns: int) -> float:
    """Return the 99th percentile of the age of state at all clients [ms], of frames between two session times."""
    ages = [
        (log["handed_ns"] - log["state_ns"])[(log["handed_ns"] >= begin_ns) & (log["handed_ns"] < end_ns)]
        for log in logs.values()
    ]
    together = np.concatenate(ages)
    if not len(together):
        raise BenchError("no client received state while the client joined, or before or after it: increase --seconds")
    return round(float(np.percentile(together, 99)) * 1e-6, 3)


class _Joiner:
    """Process that joins. It is started before it is needed: starting Python is not part of joining."""

    def __init__(self, folder: Path, bare_port: int) -> None:
        self._cache, self._bare_port = str(folder / "cache"), bare_port
        self._process: ChildProcess | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        if self._process is not None:
            self._process.close()

    def prepare(self, session: Session) -> None:
        """Start the process, once, during the warm-up."""
        if self._process is not None:
            return
        job = JoinJob(session.address, session.origin_ns, self._cache, self._bare_port)
        self._process = ChildProcess("iris_session.bench.join_clients", stdout=PIPE, own_group=True)
        self._write_line(msgspec.json.encode(job))

    def start_join(self) -> None:
        """Let the process join."""
        self._write_line(b"go")

    def _write_line(self, line: bytes) -> None:
        assert self._process is not None
        self._process.write(line + b"\n")

    def read_result(self) -> tuple[JoinResult, JoinResult, CopyInterval, float]:
        """Return the first and second join, the interval of copying, and the seconds of the bulk transfer, run now."""
        self._read_line()
        first, second = (msgspec.json.decode(self._read_line(), type=JoinResult) for _ in range(2))
        copied = msgspec.json.decode(self._read_line(), type=CopyInterval)
        self._write_line(b"bare")
        return first, second, copied, float(self._read_line())

    def _read_line(self) -> bytes:
        assert self._process is not None
        try:
            return self._process.read_line()
        except EOFError:
            raise BenchError("the joining client failed; see its messages") from None


class _BulkServer:
    """Server of all assets in one message, in a thread."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._thread = threading.Thread(target=self._run, name="bench-bare", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        self._context.destroy(linger=0)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._socket.recv()
            self._socket.send_multipart([path.read_bytes() for path in self._paths], copy=False)
            self._socket.poll(60_000)  # until it is sent
        except zmq.ZMQError:  # closed
            return
