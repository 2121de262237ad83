"""Who joins in `bench join`: a client with an empty cache, then another with what that one left; and what both are
compared with: threads of the same priority that only copy memory, and a bare transfer.

    python -m iris_session.bench.join_clients < job.json

Prints `ready`, waits for a line, joins, and prints a `Joined` for each of the two as one line of JSON, then a `Copied`;
waits for another line, and prints the seconds of the bare transfer.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np
import zmq

from iris_session.client import AssetStore, Client
from iris_session.protocol.scene import SceneSpec, asset_addresses, decode_scene
from iris_session.scene import decode_image, decode_mesh
from iris_session.system.priority import lower_thread_priority

JOIN_S: Final = 60.0
#: Memory is copied for so long, after a pause in which the machine has nothing to do with joining any more; by as many
#: threads as a client has for assets.
COPY_S: Final = 2.0
PAUSE_S: Final = 0.5
COPY_THREADS: Final = 2
COPY_BYTES: Final = 16 << 20


class JoinJob(msgspec.Struct, frozen=True):
    """`bare_port`: where the same bytes come in one message."""

    address: str
    origin_ns: int
    cache: str
    bare_port: int


class JoinResult(msgspec.Struct, frozen=True):
    """Times from `connect` on [s]. `first_picture_s`: specification and the coarsest shape of everything, decoded.
    `complete_s`: all assets, verified by hash and decoded. `begin_ns`, `end_ns`: session time."""

    first_picture_s: float
    complete_s: float
    bytes: int
    assets: int
    cpu_s: float
    begin_ns: int
    end_ns: int


def join(job: JoinJob) -> JoinResult:
    """One client, from nothing to a whole scene. Raises what the client raises."""
    begin_ns, cpu_s = time.monotonic_ns(), time.process_time()
    with Client(job.address, role="observer", name="joiner", alignment="not_needed") as client:
        client.assets.cache = AssetStore(job.cache)
        scene = client.connection.mirror.scene_hash
        first = client.assets.fetch([scene], decode=lambda _, data: decode_scene(data))
        client.wait_for(lambda _: first.done, JOIN_S)
        first.check()
        spec: SceneSpec = first.decoded[scene]
        sizes, decode = asset_addresses(spec), _make_decoder(spec)
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
            begin_ns - job.origin_ns,
            end_ns - job.origin_ns,
        )


class CopyInterval(msgspec.Struct, frozen=True):
    """When memory was copied: session time."""

    begin_ns: int
    end_ns: int


def copy_memory(origin_ns: int) -> CopyInterval:
    """As low as a client's threads for assets, and without any of their work: what every program costs the others that
    leaves no core idle. numpy copies without Python's lock."""
    time.sleep(PAUSE_S)
    begin_ns = time.monotonic_ns()
    end_ns = begin_ns + round(COPY_S * 1e9)

    def work() -> None:
        lower_thread_priority()
        source, target = np.ones(COPY_BYTES, np.uint8), np.zeros(COPY_BYTES, np.uint8)
        while time.monotonic_ns() < end_ns:
            np.copyto(target, source)

    threads = [threading.Thread(target=work) for _ in range(COPY_THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return CopyInterval(begin_ns - origin_ns, end_ns - origin_ns)


def _make_decoder(spec: SceneSpec) -> Callable[[str, memoryview], Any]:
    """What a viewer makes of every asset, by what the scene says of it: this one has meshes and images."""
    meshes = {level.address for mesh in spec.meshes for level in mesh.levels}
    images = {level.address: level.encoding for texture in spec.textures for level in texture.levels}

    def decode(address: str, data: memoryview) -> Any:
        if address in meshes:
            return decode_mesh(data)
        return decode_image(data, images[address])

    return decode


def transfer_in_bulk(port: int) -> float:
    """Seconds for all bytes in one message of ZeroMQ, asked for once: nothing checked, stored or decoded."""
    with zmq.Context() as context, context.socket(zmq.REQ) as asking:
        asking.linger = 0
        asking.connect(f"tcp://127.0.0.1:{port}")
        began_s = time.perf_counter()
        asking.send(b"everything")
        asking.recv_multipart(copy=False)
        return time.perf_counter() - began_s


def main() -> None:
    job = msgspec.json.decode(sys.stdin.readline(), type=JoinJob)
    gc.collect()
    gc.freeze()  # what Python and its libraries are made of is no part of joining
    print("ready", flush=True)
    sys.stdin.readline()
    for _ in range(2):
        print(msgspec.json.encode(join(job)).decode(), flush=True)
    print(msgspec.json.encode(copy_memory(job.origin_ns)).decode(), flush=True)
    sys.stdin.readline()
    print(transfer_in_bulk(job.bare_port), flush=True)


if __name__ == "__main__":
    main()
