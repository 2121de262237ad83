"""Assets in a recording: what clients draw its scenes of, so that it can be shown where the original files are not.

The file has a row per scene, with the hash of its specification, and each asset once, in pieces. An asset is known by
its SHA-256, so every reader finds changed bytes. What `list_recorded_assets` returns is what a whole file has.

`AssetQueue` reads assets of the session's store for the recorder, `AssetJoiner` and `AssetCollector` join and check
them when a file is read, and `export_assets` writes them into a folder.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from iris_session.assets.store import AssetStore
from iris_session.journal.errors import RecordingError
from iris_session.journal.messages import SceneAssets
from iris_session.protocol.assets import MAX_ASSET_BYTES, is_address
from iris_session.protocol.scene import MAX_SCENE_BYTES, MeshLevel, SceneError, SceneSpec, TextureLevel, decode_scene
from iris_session.system.files import write_output

#: What is recorded of each scene: its hash, what a client at the best level of detail needs, or all levels.
NONE: Final = "none"
SCENE: Final = "scene"
ALL: Final = "all"
RECORD_ASSETS: Final = (NONE, SCENE, ALL)
SPECIFICATION: Final = "specification of the scene"
#: Upper bound of the number of assets whose faults and names are kept: a hostile file may name any number.
MOST_ASSETS: Final = 1 << 20
#: Largest piece [bytes].
PIECE_BYTES: Final = 512 << 10
#: Time between the specifications of two patches [ns]: of patches in between, the last is recorded. The picture has
#: all of them, and the journal.
PATCH_PERIOD_NS: Final = 1_000_000_000
#: Upper bound of the scenes that wait.
MOST_SCENES: Final = 256
SCENES_FILE: Final = "scenes.json"
#: Nothing is removed from a folder to make room.
_NO_LIMIT: Final = 1 << 62


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
    for i, one in enumerate(spec.hfields):
        found.setdefault(one.address, f"height field {one.name or i}")
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
        changed: Assets that were there with other bytes only.
    """

    def __init__(self) -> None:
        self.whole: dict[str, int] = {}
        self.changed: dict[str, None] = {}
        self._address = ""
        self._parts: list[bytes] = []
        self._n_bytes = 0

    def add(self, piece: AssetPiece) -> bytes | None:
        """Add the next piece. Return the asset if it is whole now, and was not before."""
        if piece.offset == 0:
            self._address, self._parts, self._n_bytes = piece.address, [], 0
        if piece.address in self.whole or (piece.address, piece.offset) != (self._address, self._n_bytes):
            self._address, self._parts = "", []  # it is known, or a piece before it is lost
            return None
        self._parts.append(piece.data)
        self._n_bytes += len(piece.data)
        if self._n_bytes < piece.total:
            return None
        data = b"".join(self._parts)
        self._address, self._parts = "", []
        if hashlib.sha256(data).hexdigest() != piece.address:
            if len(self.changed) < MOST_ASSETS:
                self.changed[piece.address] = None
            return None
        self.changed.pop(piece.address, None)
        if len(self.whole) < MOST_ASSETS:
            self.whole[piece.address] = len(data)
        return data


class AssetCollector:
    """Compares the assets of a recording with what its scenes need. Takes items in any order but that of pieces.

    `deformables`: names of those of all scenes whose specifications are there.
    """

    def __init__(self) -> None:
        self._joiner = AssetJoiner()
        self._scenes: dict[str, str] = {}  # what was to be recorded, by hash
        self._changes: set[RecordedScene] = set()
        self._names: dict[str, dict[str, str]] = {SCENE: {}, ALL: {}}
        self._faults: dict[str, str] = {}
        self.deformables: dict[str, None] = {}

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
        self.deformables.update((one.name or one.stream, None) for one in spec.deformables)
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
        expected, changed = self._list_expected(), self._joiner.changed
        words = dict.fromkeys(changed, "is not as it was written: its bytes have another hash")
        for address in expected if finished else ():
            if address not in self._joiner.whole and address not in changed:
                words[address] = "is missing, or not whole"
        return [f"{_describe(expected, one)} {text}" for one, text in words.items() if one not in self._faults]


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


# --- assets on their way into a file ----------------------------------------------------------------------------------


class AssetRows(NamedTuple):
    """Rows of the three entities of assets that are to be written next."""

    scenes: list[RecordedScene]
    pieces: list[AssetPiece]
    faults: list[AssetFault]


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
        self._scenes: deque[tuple[SceneAssets, bool]] = deque()  # and whether it is a patch
        self._due_ns = 0
        self._wanted: deque[tuple[str, str, bool]] = deque()  # roots, addresses, and whether it is a specification
        self._known: set[str] = set()
        self._pieces: Iterator[AssetPiece] | None = None  # of the first wanted one, while it is being read
        self._left_bytes = 0  # of the present read

    def __bool__(self) -> bool:
        """Return whether something waits to be written."""
        return bool(self._scenes or self._wanted)

    def add_scene(self, scene: SceneAssets, *, is_patch: bool) -> None:
        """Add a scene, or a patched one, which replaces a patched one that still waits."""
        if not (scene.root and is_address(scene.scene_hash)):
            return  # no assets are shared
        if is_patch and self._scenes and self._scenes[-1][1]:
            self._scenes.pop()
        if len(self._scenes) >= MOST_SCENES:
            self._scenes.popleft()
            self.left_out += 1
        self._scenes.append((scene, is_patch))

    def read(self, now_ns: int, max_bytes: int) -> AssetRows:
        """Return the next rows.

        Args:
            now_ns: Session time.
            max_bytes: Bytes of assets in them.
        """
        rows = AssetRows([], [], [])
        self._left_bytes = max_bytes
        while self._left_bytes > 0:
            if self._pieces is None:
                self._take_scenes(now_ns, rows)
                if not self._wanted:
                    break
                self._pieces = self._read_asset(*self._wanted[0])
            piece, why = None, ""
            try:
                piece = next(self._pieces, None)
            except OSError as error:
                why = f"it cannot be read: {error.strerror or error}"
            except (ValueError, SceneError) as error:
                why = str(error)
            if piece is not None:
                rows.pieces.append(piece)
                self._left_bytes -= max(1, len(piece.data))
                continue
            _, address, _ = self._wanted.popleft()
            self._pieces = None
            if why:
                rows.faults.append(AssetFault(address, why))
        self.left_out += len(rows.faults)
        return rows

    def close(self, why: str) -> AssetRows:
        """Give up what waits. Return rows that say so."""
        scenes = [scene for scene, _ in self._scenes]
        addresses = [address for _, address, _ in self._wanted]
        if self._recorded != NONE:
            addresses += [scene.scene_hash for scene in scenes if scene.scene_hash not in self._known]
        self._scenes.clear()
        self._wanted.clear()
        self._pieces = None
        self.left_out += len(addresses)
        faults = [AssetFault(address, why) for address in addresses]
        return AssetRows([self._to_recorded(scene) for scene in scenes], [], faults)

    def _to_recorded(self, scene: SceneAssets) -> RecordedScene:
        return RecordedScene(scene.step, scene.session_time, scene.scene_hash, self._recorded)

    def _take_scenes(self, now_ns: int, rows: AssetRows) -> None:
        """Take scenes up to one with a new specification, which precedes all else: it may be replaced in the store."""
        while self._scenes and (self.is_ending or now_ns >= self._due_ns or not self._scenes[0][1]):
            scene, _ = self._scenes.popleft()
            self._due_ns = now_ns + PATCH_PERIOD_NS
            rows.scenes.append(self._to_recorded(scene))
            if self._recorded != NONE and scene.scene_hash not in self._known:
                self._known.add(scene.scene_hash)
                self._wanted.appendleft((scene.root, scene.scene_hash, True))
                return

    def _read_asset(self, root: str, address: str, is_scene: bool) -> Iterator[AssetPiece]:
        """Yield the pieces of an asset; want those that a specification names.

        Raises `OSError`, and `ValueError` or `SceneError` with a text that says why it is not recorded.
        """
        file, total = AssetStore(root).open_file(address)
        with file:
            most = MAX_SCENE_BYTES if is_scene else MAX_ASSET_BYTES
            if total > most:
                raise ValueError(f"it has {total} bytes, at most {most} are read")
            if self._room_bytes is not None:
                if total > self._room_bytes:
                    raise ValueError("the budget of the recording has no room for it")
                self._room_bytes -= total
            digest, parts, offset = hashlib.sha256(), list[bytes](), 0
            while not offset or offset < total:
                data = file.read(min(self._left_bytes, PIECE_BYTES, total - offset))
                if total and not data:
                    raise OSError("its file is shorter than it was")
                yield AssetPiece(address, offset, total, is_scene, data)
                digest.update(data)
                parts += [data] if is_scene else []
                offset += max(1, len(data))
        if digest.hexdigest() != address:
            raise ValueError("it was damaged in the store")
        for other in list_recorded_assets(decode_scene(b"".join(parts)), self._recorded) if is_scene else ():
            if other not in self._known:
                self._known.add(other)
                self._wanted.append((root, other, False))


# --- export into a folder ---------------------------------------------------------------------------------------------


class AssetExportError(RecordingError):
    """The assets cannot be written to the given place, or there are none."""


class AssetExport(msgspec.Struct, frozen=True):
    """Result of an export.

    `folder`: the asset store. `scenes`, `assets`, `bytes`: how much is in it. `damage`: one line per asset that is
    damaged or missing. `left_out`: one line per asset that was not recorded.
    """

    folder: str
    scenes: int
    assets: int
    bytes: int
    damage: tuple[str, ...]
    left_out: tuple[str, ...]


def export_assets(
    name: str,
    root: Path,
    found: AssetCollector,
    assets: Iterable[tuple[str, bytes]],
    scenes: Iterable[RecordedScene],
    *,
    finished: bool,
    force: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> AssetExport:
    """Write assets and scenes into a folder, from which the scenes can be shown on any machine.

    The folder is an asset store (`AssetStore`): each asset is a file that has its hash as its name. `scenes.json` lists
    the scenes in order, each with the hash of its specification.

    Args:
        name: Name of the recording, for errors.
        root: The folder; it is made if it does not exist.
        found: What the recording has.
        assets: Hash and bytes of its whole assets.
        scenes: Its scenes, in order.
        finished: See `AssetCollector.list_problems`.
        force: Write into a folder that is not empty.
        progress: Called with a text that says how far it is.

    Returns:
        What was written, and what is damaged or missing.

    Raises:
        AssetExportError: The folder is not empty or cannot be written, or the recording has no assets.
        NotARecordingError: A file can no longer be read.
    """
    summary = found.summarise()
    if not summary.present:
        why = "its session was to record none" if summary.recorded else "it has no word of them"
        raise AssetExportError(f"{name} holds no assets: {why}")
    try:
        if root.exists() and not root.is_dir():
            raise AssetExportError(f"{root} is no folder: give one that is empty or does not exist")
        if not force and root.exists() and any(root.iterdir()):
            raise AssetExportError(f"the folder {root} is not empty: give another one, or --force")
        store, n, n_bytes = AssetStore(root, _NO_LIMIT), 0, 0
        for address, data in assets:
            store.find(address)  # removes a damaged file of an earlier export, which `put` would take for the asset
            store.put(data)
            n, n_bytes = n + 1, n_bytes + len(data)
            progress(f"{n:,} assets, {n_bytes / 1e6:.1f} MB")
        listed = [{"step": one.step, "time_s": one.session_time * 1e-9, "hash": one.hash} for one in scenes]
        write_output(root / SCENES_FILE, json.dumps({"scenes": listed}, indent=1).encode())
    except OSError as error:
        raise AssetExportError(f"{root} cannot be written: {error.strerror or error}") from error
    damage = tuple(found.list_problems(finished=finished))
    return AssetExport(str(root), len(listed), n, n_bytes, damage, summary.left_out)
