"""`bench join`: prepare a scene of 300 objects and 200 MB of assets, join and fetch it, and join again with a cache.

Other clients watch the moving scene meanwhile. The age of their state is measured too, and as a reference beside a
program of the same priority that only copies memory.
"""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco
import zmq

from iris_session.assets.store import AssetStore
from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import CLIENTS, Action, BenchRun, group_clients, measure
from iris_session.bench.intervals import Log, compute_age_p99_ms
from iris_session.bench.join_clients import CopyInterval, JoinJob, JoinResult
from iris_session.bench.join_scene import PreparedScene, SceneJob, make_join_model
from iris_session.bench.plugins import PluginProcess
from iris_session.bench.report import BenchError, BenchReport, make_bar

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
        port = stack.enter_context(_serve_in_bulk(paths))
        joiner = stack.enter_context(
            PluginProcess("iris_session.bench.join_clients:Joiner", JoinJob(str(folder / "cache")))
        )
        joiner.read()  # it is made

        def start_join(run: BenchRun) -> None:
            for _ in range(2):
                joiner.send("join", run.session.address, run.session.origin_ns)
            joiner.send("copy_memory", run.session.origin_ns)

        actions: list[Action] = [(BEGIN_S, start_join)]
        got = measure(
            model,
            {CLIENTS: group_clients([ClientJob(f"client{i}", "observer", samples=True) for i in range(clients)])},
            seconds,
            actions=actions,
            assets=store.root,
            seed=seed,
            progress=progress,
        )
        first, second = (msgspec.convert(joiner.read(), JoinResult) for _ in range(2))
        copied = msgspec.convert(joiner.read(), CopyInterval)
        bare_s: float = joiner.ask("transfer_in_bulk", port)
    results = {
        **_summarize(cold, ready, first, second),
        "others_age_ms_p99": _compute_age_p99_ms(got.logs, first.begin_ns, second.end_ns),
        "others_age_ms_p99_baseline": _compute_age_p99_ms(got.logs, got.begin_ns, first.begin_ns),
        **got.summarize("late_tick_share", "scheduling", "drops"),
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
    with PluginProcess("iris_session.bench.join_scene:ScenePreparer", SceneJob(str(model), str(store))) as process:
        process.read()  # it is made
        return msgspec.convert(process.ask("prepare"), PreparedScene)


def _compute_age_p99_ms(logs: dict[str, Log], begin_ns: int, end_ns: int) -> float:
    """Return the 99th percentile of the age of state at all clients [ms], of frames between two session times."""
    p99_ms = compute_age_p99_ms(logs.values(), begin_ns, 0.0, (end_ns - begin_ns) * 1e-9)
    if not math.isfinite(p99_ms):
        raise BenchError("no client received state while the client joined, or before or after it: increase --seconds")
    return p99_ms


@contextmanager
def _serve_in_bulk(paths: list[Path]) -> Iterator[int]:
    """Serve all assets in one message, in a thread. Yield the port."""
    with zmq.Context() as context:
        socket = context.socket(zmq.REP)
        port = socket.bind_to_random_port("tcp://127.0.0.1")

        def serve() -> None:
            with suppress(zmq.ZMQError):  # closed
                socket.recv()
                socket.send_multipart([path.read_bytes() for path in paths], copy=False)
                socket.poll(60_000)  # until it is sent

        thread = threading.Thread(target=serve, name="bench-bare", daemon=True)
        thread.start()
        try:
            yield port
        finally:
            context.destroy(linger=0)
            thread.join()
