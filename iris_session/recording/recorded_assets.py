"""Assets in a recording: what clients draw its scenes of, so that it can be shown where the original files are not.

The file has a row per scene, with the hash of its specification, and each asset once, in pieces. An asset is known by
its SHA-256, so every reader finds changed bytes. What `list_recorded_assets` returns is what a whole file has.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from iris_session.protocol.assets import MAX_ASSET_BYTES, is_address
from iris_session.protocol.scene import MAX_SCENE_BYTES, MeshLevel, SceneError, SceneSpec, TextureLevel, decode_scene

#: What is recorded of each scene: its hash, what a client at the best level of detail needs, or all levels.
NONE: Final = "none"
SCENE: Final = "scene"
ALL: Final = "all"
RECORD_ASSETS: Final = (NONE, SCENE, ALL)
SPECIFICATION: Final = "specification of the scene"
#: Upper bound of the number of assets whose faults and names are kept: a hostile file may name any number.
MOST_ASSETS: Final = 1 << 20


class RecordedScene(NamedTuple):
    """A scene or a patched one.

    Attributes:
        step: Newest step before it was loaded or patched; -1: the session began with it.
        session_time: Session time of that step [ns].
        hash: SHA-256 of its specification, as 64 hex digits: the asset to begin with.
        recorded: What the session was to record of it: `none`, `scene` or `all`.
    """

    step: int
    session_time: int
    hash: str
    recorded: str


class AssetPiece(NamedTuple):
    """Some bytes of an asset, from `offset` on, of `total`. `is_scene`: the asset is the specification of a scene."""

    address: str
    offset: int
    total: int
    is_scene: bool
    data: bytes


class AssetFault(NamedTuple):
    """An asset that could not be recorded, and why."""

    address: str
    text: str


class AssetsSummary(msgspec.Struct, frozen=True):
    """Assets in a recording.

    `recorded`: `none`, `scene` or `all`; empty if the file has no word of assets: it was made by an earlier version, or
    the session shared no scene. `scenes`: number of scenes and patched scenes. `expected`: number of assets that belong
    to them, as far as their specifications are there; `present`, `bytes`: those that are whole, and their size.
    `left_out`: one line per asset that could not be recorded.
    """

    recorded: str = ""
    scenes: int = 0
    expected: int = 0
    present: int = 0
    bytes: int = 0
    left_out: tuple[str, ...] = ()


def list_recorded_assets(spec: SceneSpec, recorded: str) -> dict[str, str]:
    """Return the assets of a scene besides its specification: address, and name for people, each once.

    Args:
        spec: The scene.
        recorded: `NONE`, `SCENE` (the finest level of each mesh and texture) or `ALL`.
    """
    found: dict[str, str] = {}
    if recorded == NONE:
        return found
    for i, field in enumerate(spec.hfields):
        found.setdefault(field.address, f"height field {field.name or i}")
    for i, deformable in enumerate(spec.deformables):
        found.setdefault(deformable.address, f"deformable {deformable.name or i}")
    ladders: list[tuple[str, Sequence[MeshLevel | TextureLevel]]] = []
    ladders += [(f"mesh {mesh.name or i}", mesh.levels) for i, mesh in enumerate(spec.meshes)]
    ladders += [(f"texture {texture.name or i}", texture.levels) for i, texture in enumerate(spec.textures)]
    for depth in range(max((len(levels) for _, levels in ladders), default=0) if recorded == ALL else 1):
        for name, levels in ladders:
            if depth < len(levels):
                found.setdefault(levels[depth].address, f"{name}, level {depth}" if depth else name)
    return found


class AssetJoiner:
    """Joins the pieces of assets, which a recorder writes one asset after the other.

    Attributes:
        whole: Assets that were there with the right bytes, with their sizes.
        broken: Assets that were there otherwise only: `changed` or `incomplete`.
    """

    def __init__(self) -> None:
        self.whole: dict[str, int] = {}
        self.broken: dict[str, str] = {}
        self._address = ""
        self._parts: list[bytes] = []
        self._n_bytes = 0

    def add(self, piece: AssetPiece) -> bytes | None:
        """Add the next piece. Return the asset if it is whole now, and was not before."""
        if piece.offset == 0:
            self.end()
            self._address, self._parts, self._n_bytes = piece.address, [], 0
        if piece.address in self.whole:
            self._address = ""
            return None
        if piece.address != self._address or piece.offset != self._n_bytes:  # a piece before it is lost
            self.end()
            self._set_broken(piece.address, "incomplete")
            return None
        self._parts.append(piece.data)
        self._n_bytes += len(piece.data)
        if self._n_bytes < piece.total:
            return None
        data = b"".join(self._parts)
        self._address, self._parts = "", []
        if hashlib.sha256(data).hexdigest() != piece.address:
            self._set_broken(piece.address, "changed")
            return None
        self.broken.pop(piece.address, None)
        if len(self.whole) < MOST_ASSETS:
            self.whole[piece.address] = len(data)
        return data

    def end(self) -> None:
        """Note the asset whose last pieces have not come."""
        if self._address:
            self._set_broken(self._address, "incomplete")
        self._address, self._parts = "", []

    def _set_broken(self, address: str, why: str) -> None:
        if len(self.broken) < MOST_ASSETS:
            self.broken[address] = why


class AssetCollector:
    """Compares the assets of a recording with what its scenes need. Takes items in any order but that of pieces."""

    def __init__(self) -> None:
        self._joiner = AssetJoiner()
        self._scenes: dict[str, str] = {}  # what was to be recorded, by hash
        self._changes: set[RecordedScene] = set()
        self._names: dict[str, dict[str, str]] = {SCENE: {}, ALL: {}}
        self._faults: dict[str, str] = {}

    def add(self, item: RecordedScene | AssetPiece | AssetFault) -> None:
        """Add an item of the recording. A part that repeats an item of the one before changes nothing."""
        if isinstance(item, AssetPiece):
            data = self._joiner.add(item)
            if data is not None and item.is_scene:
                self._read_scene(data)
        elif isinstance(item, RecordedScene):
            if len(self._changes) < MOST_ASSETS:
                self._changes.add(item)
                self._scenes[item.hash] = item.recorded
        elif len(self._faults) < MOST_ASSETS:
            self._faults[item.address] = item.text

    def _read_scene(self, data: bytes) -> None:
        if len(data) > MAX_SCENE_BYTES:
            return
        try:
            spec = decode_scene(data)
        except SceneError:  # its hash is right, so it was so in the session too: of another version
            return
        for recorded, names in self._names.items():
            names.update(list_recorded_assets(spec, recorded))

    def _list_expected(self) -> dict[str, str]:
        """Return the assets that are to be in the file, with their names."""
        expected = {scene: SPECIFICATION for scene, recorded in self._scenes.items() if recorded != NONE}
        for recorded in set(self._scenes.values()):
            expected.update(self._names.get(recorded, {}))
        return expected

    def summarise(self) -> AssetsSummary:
        """Return the summary of what was added."""
        expected, whole = self._list_expected(), self._joiner.whole
        present = [size for address, size in whole.items() if address in expected]
        left_out = tuple(
            f"{_describe(expected, address)}: {text}" for address, text in self._faults.items() if address not in whole
        )
        recorded = next((kind for kind in reversed(RECORD_ASSETS) if kind in self._scenes.values()), "")
        return AssetsSummary(recorded, len(self._changes), len(expected), len(present), sum(present), left_out)

    def list_problems(self, *, finished: bool) -> list[str]:
        """Return a line per asset that is damaged or missing, without those that could not be recorded.

        Args:
            finished: Recorders closed all files. One that was killed may have left assets to be written, and the next
                one gets the newest scene only.
        """
        self._joiner.end()
        expected, broken = self._list_expected(), self._joiner.broken
        missing = [one for one in expected if one not in self._joiner.whole and one not in broken] if finished else []
        damaged = {one: why for one, why in broken.items() if why == "changed" or finished}
        lines = {**damaged, **dict.fromkeys(missing, "missing")}
        return [
            f"{_describe(expected, address)} {_WORDS[why]}"
            for address, why in lines.items()
            if address not in self._faults
        ]


_WORDS: Final = {
    "changed": "is not as it was written: its bytes have another hash",
    "incomplete": "is not whole: some of its bytes are missing",
    "missing": "is missing",
}


def _describe(names: dict[str, str], address: str) -> str:
    name = names.get(address)
    return f"asset {address[:12]}" + (f" ({name[:80]})" if name else "")


def check_piece(piece: AssetPiece) -> AssetPiece:
    """Return a piece of a file. Raises `ValueError` if its address or numbers cannot be right."""
    if not is_address(piece.address):
        raise ValueError(f"{piece.address[:80]!r} is no address of an asset")
    if not 0 <= piece.offset <= piece.offset + len(piece.data) <= piece.total <= MAX_ASSET_BYTES:
        raise ValueError(f"bytes {piece.offset} and following of an asset of {piece.total} bytes")
    return piece
