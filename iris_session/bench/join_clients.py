"""Process that joins in `bench join`: a client with an empty cache, then one with the cache of the first.

It also runs the references: threads of the same priority that only copy memory, and a bulk transfer.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np
import zmq

from iris_session.bench.plugins import Plugin
from iris_session.client import AssetStore, Client
from iris_session.protocol.scene import SceneSpec, decode_scene, list_assets
from iris_session.scene import decode_image, decode_mesh
from iris_session.system.priority import lower_thread_priority

JOIN_S: Final = 60.0
#: Time of copying memory, after a pause in which work of the join ends, with as many threads as a client has for
#: assets.
COPY_S: Final = 2.0
PAUSE_S: Final = 0.5
COPY_THREADS: Final = 2
COPY_BYTES: Final = 16 << 20


class JoinJob(msgspec.Struct, frozen=True):
    """Job of the process. `cache`: folder of assets, empty at first."""

    cache: str


class JoinResult(msgspec.Struct, frozen=True):
    """Times of one join from `connect` on [s].

    `first_picture_s`: specification and the coarsest level of every shape are decoded. `complete_s`: all assets are
    verified by hash and decoded. `begin_ns`, `end_ns`: session time.
    """

    first_picture_s: float
    complete_s: float
    bytes: int
    assets: int
    cpu_s: float
    begin_ns: int
    end_ns: int


class CopyInterval(msgspec.Struct, frozen=True):
    """Interval in which memory was copied, in session time."""

    begin_ns: int
    end_ns: int


class Joiner(Plugin):
    """Plug-in that joins. It is started before it is needed: starting Python is not part of joining."""

    job_type = JoinJob

    def __init__(self, job: JoinJob) -> None:
        super().__init__(job)
        gc.collect()
        gc.freeze()  # Python and its libraries are not part of joining

    def join(self, address: str, origin_ns: int) -> JoinResult:
        """Join with one client and fetch the whole scene. Raises what the client raises."""
        begin_ns, cpu_s = time.monotonic_ns(), time.process_time()
        with Client(address, role="observer", name="joiner", alignment="not_needed") as client:
            client.assets.cache = AssetStore(self.job.cache)
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
            return JoinResult(
                (picture_ns - begin_ns) * 1e-9,
                (end_ns - begin_ns) * 1e-9,
                first.bytes_received + rest.bytes_received,
                1 + len(sizes),
                time.process_time() - cpu_s,
                begin_ns - origin_ns,
                end_ns - origin_ns,
            )

    def copy_memory(self, origin_ns: int) -> CopyInterval:
        """Copy memory at the priority of a client's asset threads.

        This is the cost of any program that leaves no core idle. numpy copies without holding Python's lock.
        """
        time.sleep(PAUSE_S)
        begin_ns = time.monotonic_ns()
        end_ns = begin_ns + round(COPY_S * 1e9)

        def copy_until_end() -> None:
            lower_thread_priority()
            source, target = np.ones(COPY_BYTES, np.uint8), np.zeros(COPY_BYTES, np.uint8)
            while time.monotonic_ns() < end_ns:
                np.copyto(target, source)

        threads = [threading.Thread(target=copy_until_end) for _ in range(COPY_THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return CopyInterval(begin_ns - origin_ns, end_ns - origin_ns)

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
