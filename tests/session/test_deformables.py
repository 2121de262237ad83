"""Streams of deformables: repeated once a second at rest, with the time of their state."""

from __future__ import annotations

import numpy as np

from iris_session.protocol.names import MediaEncoding
from iris_session.session.deformables import REPEAT_NS, DeformableSourceMesh, DeformableStreams
from tests.session.published import CLOTH, composed

MS = 1_000_000


def test_resting_mesh_is_repeated_with_its_original_time() -> None:
    vertices = CLOTH.copy()
    sent: list[tuple[str, int, int]] = []
    taken = True

    def publish(stream: str, frames: dict[str, bytes], capture_ns: int, epoch: int, encoding: str) -> bool:
        assert frames
        assert encoding == MediaEncoding.DEFORMABLE
        sent.append((stream, capture_ns, epoch))
        return taken

    topology = composed().deformables["cloth"].topology
    streams = DeformableStreams([DeformableSourceMesh("cloth", topology, lambda: vertices)], publish)
    for now_ns in range(0, 2 * REPEAT_NS + 1, 250 * MS):
        streams.publish(1, now_ns, 0)
    assert sent == [("cloth", 0, 1)] * 3, "the state stands, its source is silent"
    vertices = vertices + np.float32(0.1)
    streams.publish(1, 2 * REPEAT_NS + 16 * MS, 2 * REPEAT_NS + 16 * MS)
    streams.publish(2, 2 * REPEAT_NS + 32 * MS, 2 * REPEAT_NS + 32 * MS)
    assert sent[3:] == [("cloth", 2 * REPEAT_NS + 16 * MS, 1), ("cloth", 2 * REPEAT_NS + 32 * MS, 2)]
    taken = False
    streams.publish(3, 2 * REPEAT_NS + 48 * MS, 2 * REPEAT_NS + 48 * MS)
    streams.publish(3, 2 * REPEAT_NS + 64 * MS, 2 * REPEAT_NS + 64 * MS)
    assert len(sent) == 7, "what nobody got is sent anew"
    streams.replace_meshes([])
    streams.publish(4, 9 * REPEAT_NS, 9 * REPEAT_NS)
    assert len(sent) == 7
