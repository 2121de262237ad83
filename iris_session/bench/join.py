"""`bench join`: prepare a scene of 300 objects and 200 MB of assets, join and fetch it, and join again with a cache.

Other clients watch the moving scene meanwhile. The age of their state is measured too, and as a reference beside a
program of the same priority that only copies memory.
"""

from __future__ import annotations

import gc
import math
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
import psutil
import zmq
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import BenchRun, Log, compute_age_p99_ms, measure
from iris_session.bench.plugins import Plugin, PluginProcess
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.client import Client
from iris_session.demo.scenes import free_bodies_scene
from iris_session.physics.load import load_model
from iris_session.protocol.scene import SceneSpec, decode_scene, encode_scene, list_assets
from iris_session.scene import decode_image, decode_mesh
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.system.priority import lower_thread_priority

#: Time from the beginning of the window to the join; the baseline of the others is measured first.
BEGIN_S: Final = 4.0


def run_join(
    objects: int = 300,
    assets_mb: float = 200.0,
    clients: int = 4,
    seconds: float = 20.0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Join with one client while observers watch.

    References, in the same run: the same bytes in one message, and the age of the others' state while memory is copied
    at the priority at which a client loads assets.
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
        if ready["built"]:
            raise BenchError(f"{ready['built']} assets were encoded again although the cache is warm")
        paths = [store.path(address) for address in ready["addresses"]]
        joiner = stack.enter_context(PluginProcess("iris_session.bench.join:Joiner", str(folder / "cache")))
        joiner.read()  # it is made

        def start_join(run: BenchRun) -> None:
            for _ in range(2):
                joiner.send("join", run.session.address, run.session.origin_ns)
            joiner.send("copy_memory", run.session.origin_ns)

        got = measure(
            model,
            [ClientJob(f"client{i}", "observer", samples=True) for i in range(clients)],
            seconds,
            actions=[(BEGIN_S, start_join)],
            assets=store.root,
            seed=seed,
            progress=progress,
        )
        (first, begin_ns, _), (second, _, end_ns), copied = (joiner.read() for _ in range(3))
        bare_s = _transfer_in_bulk(joiner, paths)
    results = {
        "ready_s": round(ready["seconds"], 3),
        "server_rss_mib": round(ready["rss_mib"], 1),
        "first_picture_s": first["first_picture_s"],
        "complete_s": first["complete_s"],
        "bytes": first["bytes"],
        "warm_complete_s": second["complete_s"],
        "warm_bytes": second["bytes"],
        "assets": first["assets"],
        "client_cpu_s": first["client_cpu_s"],
        "ready_cold_s": round(cold["seconds"], 3),
        "server_rss_cold_mib": round(cold["rss_mib"], 1),
        "others_age_ms_p99": _compute_age_p99_ms(got.logs, begin_ns, end_ns),
        "others_age_ms_p99_baseline": _compute_age_p99_ms(got.logs, got.begin_ns, begin_ns),
        **got.summarize("late_tick_share", "scheduling", "drops"),
    }
    reference = {
        "bare_transfer_s": round(bare_s, 3),
        "others_age_ms_p99_memory_copied": _compute_age_p99_ms(got.logs, *copied),
    }
    bars = (
        make_bar(results, "ready_s", "<=", 2.0),
        make_bar(results, "server_rss_mib", "<=", 150.0),
        make_bar(results, "complete_s", "<=", 1.0),
        make_bar(results, "warm_bytes", "<=", 0.01 * first["bytes"]),
        make_bar(results, "others_age_ms_p99", "<=", 3.0),
    )
    return BenchReport(results, bars, reference)


def _prepare_scene(model: Path, store: Path) -> dict[str, Any]:
    with PluginProcess("iris_session.bench.join:ScenePreparer", str(model), str(store)) as process:
        process.read()  # it is made
        prepared: dict[str, Any] = process.ask("prepare")
        return prepared


def _compute_age_p99_ms(logs: dict[str, Log], begin_ns: int, end_ns: int) -> float:
    """Return the 99th percentile of the age of state at all clients [ms], of frames between two session times."""
    p99_ms = compute_age_p99_ms(list(logs.values()), begin_ns, 0.0, (end_ns - begin_ns) * 1e-9)
    if not math.isfinite(p99_ms):
        raise BenchError("no client received state while the client joined, or before or after it: increase --seconds")
    return p99_ms


def _transfer_in_bulk(joiner: PluginProcess, paths: list[Path]) -> float:
    """Return the seconds for all assets in one message."""
    with zmq.Context() as context, context.socket(zmq.REP) as socket:
        socket.linger = 0
        joiner.send("transfer_in_bulk", socket.bind_to_random_port("tcp://127.0.0.1"))
        if not socket.poll(round(JOIN_S * 1e3)):
            raise BenchError("the process that joins does not ask for the bulk transfer")
        socket.recv()
        socket.send_multipart([path.read_bytes() for path in paths], copy=False)
        bare_s: float = joiner.read()
        return bare_s


# --- the process that joins -------------------------------------------------------------------------------------------


JOIN_S: Final = 60.0
#: Threads that copy memory, as many as a client has for assets.
COPY_THREADS: Final = 2


class Joiner(Plugin):
    """Plug-in that joins. It is started before it is needed: starting Python is not part of joining.

    Args:
        cache: Folder of assets, empty at first.
    """

    def __init__(self, cache: str) -> None:
        self._cache = cache
        gc.collect()
        gc.freeze()  # Python and its libraries are not part of joining

    def join(self, address: str, origin_ns: int) -> tuple[dict[str, float], int, int]:
        """Join with one client and fetch the whole scene. Return the results, and session times of begin and end [ns].

        Results are times from `connect` on [s]: at `first_picture_s` specification and the coarsest level of every
        shape are decoded, at `complete_s` all assets are verified by hash and decoded.
        """
        begin_ns, cpu_s = time.monotonic_ns(), time.process_time()
        with Client(address, role="observer", name="joiner", alignment="not_needed") as client:
            client.assets.cache = AssetStore(self._cache)
            scene = client.connection.mirror.scene_hash
            first = client.assets.fetch([scene], decode=lambda _, data: decode_scene(data))
            client.wait_for(lambda _: first.done, JOIN_S)
            first.check()
            spec: SceneSpec = first.decoded[scene]
            sizes, decode = list_assets(spec), _make_decoder(spec)
            shapes = {mesh.levels[-1].address for mesh in spec.meshes} | {field.address for field in spec.hfields}
            rest = client.assets.fetch(sizes, decode=decode)
            client.wait_for(lambda _: shapes.isdisjoint(rest.pending), JOIN_S)
            picture_ns = time.monotonic_ns()
            client.wait_for(lambda _: rest.done, JOIN_S)
            end_ns = time.monotonic_ns()
            rest.check()
            assert len(rest.decoded) == len(sizes)
            results = {
                "first_picture_s": round((picture_ns - begin_ns) * 1e-9, 3),
                "complete_s": round((end_ns - begin_ns) * 1e-9, 3),
                "bytes": first.bytes_received + rest.bytes_received,
                "assets": 1 + len(sizes),
                "client_cpu_s": round(time.process_time() - cpu_s, 3),
            }
            return results, begin_ns - origin_ns, end_ns - origin_ns

    def copy_memory(self, origin_ns: int) -> tuple[int, int]:
        """Copy memory at the priority of a client's asset threads; return session times of begin and end [ns].

        This is the cost of any program that leaves no core idle. numpy copies without holding Python's lock.
        """
        time.sleep(0.5)  # work of the join ends
        begin_ns = time.monotonic_ns()
        end_ns = begin_ns + 2_000_000_000

        def copy_until_end() -> None:
            lower_thread_priority()
            source, target = np.ones(16 << 20, np.uint8), np.zeros(16 << 20, np.uint8)
            while time.monotonic_ns() < end_ns:
                np.copyto(target, source)

        with ThreadPoolExecutor(COPY_THREADS) as pool:
            for copying in [pool.submit(copy_until_end) for _ in range(COPY_THREADS)]:
                copying.result()
        return begin_ns - origin_ns, end_ns - origin_ns

    def transfer_in_bulk(self, port: int) -> float:
        """Return the seconds for all bytes in one ZeroMQ message: nothing is checked, stored or decoded."""
        with zmq.Context() as context, context.socket(zmq.REQ) as asking:
            asking.linger = 0
            asking.connect(f"tcp://127.0.0.1:{port}")
            began_s = time.perf_counter()
            asking.send(b"everything")
            if not asking.poll(round(JOIN_S * 1e3)):
                raise TimeoutError("the bulk transfer did not arrive")
            asking.recv_multipart(copy=False)
            return time.perf_counter() - began_s


def _make_decoder(spec: SceneSpec) -> Callable[[str, memoryview], Any]:
    """Return the decoder of a viewer for the assets of a scene: meshes and images."""
    meshes = {level.address for mesh in spec.meshes for level in mesh.levels}
    images = {level.address: level.encoding for texture in spec.textures for level in texture.levels}

    def decode(address: str, data: memoryview) -> Any:
        if address in meshes:
            return decode_mesh(data)
        return decode_image(data, images[address])

    return decode


# --- the scene --------------------------------------------------------------------------------------------------------


MESHES: Final = 60
TEXTURES: Final = 60
#: Share of the bytes in textures; meshes have the rest.
TEXTURE_SHARE: Final = 0.8
#: Measured ratios with coarser levels: bytes of a texture per byte of raw pixels, bytes of a mesh per vertex.
_LEVELS: Final = 1.228
_VERTEX_BYTES: Final = 35.5


def make_join_model(objects: int, assets_mb: float, seed: int) -> Any:
    """Return an `mujoco.MjSpec` of moving bodies that share 60 meshes and 60 textures, about `assets_mb` MB."""
    spec = free_bodies_scene(objects, seed)
    rng = np.random.default_rng(seed)
    side = max(16, round((assets_mb * 1e6 * TEXTURE_SHARE / TEXTURES / 3 / _LEVELS) ** 0.5))
    vertices = max(100, round(assets_mb * 1e6 * (1.0 - TEXTURE_SHARE) / MESHES / _VERTEX_BYTES))
    for i in range(TEXTURES):
        pixels = rng.integers(0, 256, (side, side, 3), np.uint8)  # noise does not compress
        spec.add_texture(
            name=f"texture{i}",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=side,
            height=side,
            nchannel=3,
            data=pixels.ravel().tolist(),
        )
        material = spec.add_material(name=f"material{i}")
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = f"texture{i}"
    for i in range(MESHES):
        points, faces, uv = _make_stone(rng, vertices)
        spec.add_mesh(
            name=f"mesh{i}",
            uservert=points.ravel().tolist(),
            userface=faces.ravel().tolist(),
            usertexcoord=uv.ravel().tolist(),
            userfacetexcoord=faces.ravel().tolist(),
        )
    for i, body in enumerate(body for body in spec.bodies if body.name.startswith("body")):
        geom = body.first_geom()
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = f"mesh{i % MESHES}"
        geom.material = f"material{i % TEXTURES}"
    return spec


def _make_stone(
    rng: np.random.Generator, vertices: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return points [m] of a rough ball of 6 cm, triangles and texture coordinates."""
    rows = max(4, round((vertices / 2) ** 0.5))
    columns = 2 * rows
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns, endpoint=False), indexing="ij")
    theta, phi = np.pi * (0.02 + 0.96 * v), 2 * np.pi * u
    radius = 0.06 * rng.uniform(0.97, 1.0, theta.shape)
    points = radius[..., None] * np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    at = np.arange(rows * columns).reshape(rows, columns)
    at = np.hstack([at, at[:, :1]])  # closed
    top, bottom = np.full(columns, at[0, 0]), np.full(columns, at[-1, 0])
    caps = [np.stack([top, at[0, :-1], at[0, 1:]], -1), np.stack([bottom, at[-1, 1:], at[-1, :-1]], -1)]
    faces = np.concatenate([split_quads(at), *(cap[1:-1] for cap in caps)])
    return points.reshape(-1, 3), faces, np.stack([u, v], axis=-1).reshape(-1, 2)


def split_quads(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles (n, 3) of a grid of vertices, two for each of its cells."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


class ScenePreparer(Plugin):
    """Plug-in that prepares a compiled model as a server does at its start.

    The memory of a scene can only be measured in a process that did nothing else.
    """

    def __init__(self, model: str, store: str) -> None:
        self._model, self._store = load_model(model), AssetStore(store)

    def prepare(self) -> dict[str, Any]:
        """Prepare the scene, and measure it.

        Returns:
            `seconds` from the compiled model to assets that can be fetched; `rss_mib`, peak memory meanwhile above that
            of the process with the model; `built`, the number of assets that were encoded; `addresses` of all assets.
        """
        before = psutil.Process().memory_info().rss
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory is counted from now on (Linux)
        began_s = time.perf_counter()
        parsed = parse_mujoco(self._model, self._store)
        scene = self._store.put(encode_scene(parsed.spec))
        seconds = time.perf_counter() - began_s
        rss_mib = (_read_peak_rss() - before) / 2**20
        addresses = [scene, *list_assets(parsed.spec)]
        return {"seconds": seconds, "rss_mib": rss_mib, "built": parsed.built, "addresses": addresses}


def _read_peak_rss() -> int:
    """Return the peak resident memory of this process [bytes] since the last reset of the peak."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024
