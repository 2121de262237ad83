"""Assets on their way into a recording: read from the session's store, piece by piece, by the recorder process.

Nothing waits for them: each call of `AssetQueue.read` reads a bounded number of bytes, after the journal was written.
An asset that cannot be read is counted and noted in the file.
"""

from __future__ import annotations

import hashlib
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, BinaryIO, Final, NamedTuple

from iris_session.protocol.assets import MAX_ASSET_BYTES, is_address
from iris_session.protocol.scene import MAX_SCENE_BYTES, SceneError, decode_scene
from iris_session.recording.messages import SceneAssets
from iris_session.recording.recorded_assets import (
    NONE,
    AssetFault,
    AssetPiece,
    RecordedScene,
    list_recorded_assets,
)
from iris_session.scene import AssetStore

#: Largest piece [bytes].
PIECE_BYTES: Final = 512 << 10
#: Time between the specifications of two patches [ns]: of patches in between, the last is recorded. The picture has
#: all of them, and the journal.
PATCH_PERIOD_NS: Final = 1_000_000_000
#: Upper bound of what waits: scenes, and assets of them.
MOST_SCENES: Final = 256
MOST_QUEUED: Final = 1 << 16


class AssetRows(NamedTuple):
    """Rows of the three entities of assets that are to be written next."""

    scenes: list[RecordedScene]
    pieces: list[AssetPiece]
    faults: list[AssetFault]


@dataclass
class _Waiting:
    """A scene whose specification is not written yet."""

    scene: SceneAssets
    is_patch: bool


@dataclass
class _Reading:
    """An asset that is being read."""

    address: str
    root: str
    file: BinaryIO
    total: int
    is_scene: bool
    offset: int = 0
    digest: Any = field(default_factory=hashlib.sha256)
    parts: list[bytes] = field(default_factory=list)  # of a specification


class AssetQueue:
    """Assets of the scenes of a session that are not in the file yet.

    Args:
        recorded: `none`, `scene` or `all`.
        limit_bytes: Bytes of assets that the file may have; further ones are left out.

    Attributes:
        left_out: Number of assets that could not be recorded.
        is_ending: Patches come no more, so none is waited for.
    """

    def __init__(self, recorded: str = NONE, limit_bytes: int | None = None) -> None:
        self.left_out = 0
        self.is_ending = False
        self._recorded = recorded
        self._room_bytes = limit_bytes
        self._scenes: deque[_Waiting] = deque()
        self._due_ns = 0
        self._wanted: deque[tuple[str, str]] = deque()  # roots and addresses
        self._known: set[str] = set()
        self._reading: _Reading | None = None

    def __bool__(self) -> bool:
        """Return whether something waits to be written."""
        return bool(self._scenes or self._wanted or self._reading)

    def add_scene(self, scene: SceneAssets, *, is_patch: bool) -> None:
        """Add a scene, or a patched one, which replaces a patched one that still waits."""
        if not (scene.root and is_address(scene.scene_hash)):
            return  # no assets are shared
        if is_patch and self._scenes and self._scenes[-1].is_patch:
            self._scenes.pop()
        if len(self._scenes) >= MOST_SCENES:
            self._scenes.popleft()
            self.left_out += 1
        self._scenes.append(_Waiting(scene, is_patch))

    def read(self, now_ns: int, max_bytes: int) -> AssetRows:
        """Return the next rows.

        Args:
            now_ns: Session time.
            max_bytes: Bytes of assets in them.
        """
        rows = AssetRows([], [], [])
        left = max_bytes
        while left > 0 and (self._reading is not None or self._open_next(now_ns, rows)):
            left -= self._read_piece(min(left, PIECE_BYTES), rows)
        self.left_out += len(rows.faults)
        return rows

    def close(self, why: str) -> AssetRows:
        """Give up what waits. Return rows that say so."""
        rows = AssetRows([], [], [])
        if self._reading is not None:
            rows.faults.append(AssetFault(self._reading.address, why))
            self._end_reading()
        for waiting in self._scenes:
            scene = waiting.scene
            rows.scenes.append(RecordedScene(scene.step, scene.session_time, scene.scene_hash, self._recorded))
            if self._recorded != NONE and scene.scene_hash not in self._known:
                rows.faults.append(AssetFault(scene.scene_hash, why))
        rows.faults.extend(AssetFault(address, why) for _, address in self._wanted)
        self._scenes.clear()
        self._wanted.clear()
        self.left_out += len(rows.faults)
        return rows

    def _open_next(self, now_ns: int, rows: AssetRows) -> bool:
        """Begin with the next asset, a specification before all others: it may be replaced in the store soon."""
        while self._scenes and (self.is_ending or now_ns >= self._due_ns or not self._scenes[0].is_patch):
            scene = self._scenes.popleft().scene
            self._due_ns = now_ns + PATCH_PERIOD_NS
            rows.scenes.append(RecordedScene(scene.step, scene.session_time, scene.scene_hash, self._recorded))
            known = scene.scene_hash in self._known
            self._known.add(scene.scene_hash)
            if self._recorded != NONE and not known and self._open(scene.root, scene.scene_hash, rows, is_scene=True):
                return True
        while self._wanted:
            if self._open(*self._wanted.popleft(), rows, is_scene=False):
                return True
        return False

    def _open(self, root: str, address: str, rows: AssetRows, *, is_scene: bool) -> bool:
        try:
            file, total = AssetStore(root).open_file(address)
        except (OSError, ValueError) as error:
            rows.faults.append(AssetFault(address, f"it cannot be read: {getattr(error, 'strerror', None) or error}"))
            return False
        most = MAX_SCENE_BYTES if is_scene else MAX_ASSET_BYTES
        if total > most:
            why = f"it has {total} bytes, at most {most} are read"
        elif self._room_bytes is not None and total > self._room_bytes:
            why = "the budget of the recording has no room for it"
        else:
            self._reading = _Reading(address, root, file, total, is_scene)
            return True
        file.close()
        rows.faults.append(AssetFault(address, why))
        return False

    def _read_piece(self, n_bytes: int, rows: AssetRows) -> int:
        """Read the next piece. Return its bytes, at least 1."""
        one = self._reading
        assert one is not None
        n_bytes = min(n_bytes, one.total - one.offset)
        data, why = b"", "its file is shorter than it was"
        try:
            data = one.file.read(n_bytes)
        except OSError as error:
            why = error.strerror or str(error)
        if len(data) < n_bytes:
            rows.faults.append(AssetFault(one.address, f"it cannot be read: {why}"))
            self._end_reading()
            return 1
        rows.pieces.append(AssetPiece(one.address, one.offset, one.total, one.is_scene, data))
        one.offset += len(data)
        one.digest.update(data)
        if one.is_scene:
            one.parts.append(data)
        if self._room_bytes is not None:
            self._room_bytes -= len(data)
        if one.offset == one.total:
            self._finish(one, rows)
        return max(1, len(data))

    def _finish(self, one: _Reading, rows: AssetRows) -> None:
        """Check an asset that was read, and add the assets that a specification names."""
        self._end_reading()
        if one.digest.hexdigest() != one.address:
            rows.faults.append(AssetFault(one.address, "it was damaged in the store"))
            return
        if not one.is_scene:
            return
        try:
            spec = decode_scene(b"".join(one.parts))
        except SceneError as error:
            rows.faults.append(AssetFault(one.address, str(error)))
            return
        for address in list_recorded_assets(spec, self._recorded):
            if address in self._known:
                continue
            if len(self._wanted) >= MOST_QUEUED:
                rows.faults.append(AssetFault(address, "too many assets"))
                continue
            self._known.add(address)
            self._wanted.append((one.root, address))

    def _end_reading(self) -> None:
        if self._reading is not None:
            with suppress(OSError):
                self._reading.file.close()
        self._reading = None
