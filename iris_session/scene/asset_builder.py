"""`AssetBuilder`: encode raw content to assets in a store, with levels of detail, in threads, each content once.

The key of a piece of work is the SHA-256 of its raw content, its options and `ENCODER_VERSION`; the store keeps the
result. Hashing, deflate and large copies of numpy release the interpreter's lock, so threads help. Of the pieces with
more than `ALONE_BYTES` of raw content only one is in memory at a time.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import Vec3
from iris_session.protocol.names import AssetEncoding, TextureKind
from iris_session.protocol.scene import MeshLevel, TextureLevel
from iris_session.scene.images import Pixels, encode_image, halve
from iris_session.scene.meshes import MeshArrays, encode_mesh, encode_mesh_quantised, simplify_mesh

#: Increased whenever the encoding of the same content changes.
ENCODER_VERSION: Final = 5
ALONE_BYTES: Final = 16 << 20
#: Factor between levels of a mesh, and the minimum number of triangles of a level.
_COARSER: Final = 4
_FEWEST_TRIANGLES: Final = 500
#: Maximum share of the triangles and bytes of the previous level for a level to be useful.
_SAVED: Final = 2 / 3
#: Textures are halved down to this side [pixels].
_SMALLEST_SIDE: Final = 256
#: First bytes of image files. MuJoCo stores an unknown file as one row of bytes that look like grey pixels.
_OWN_FORMS: Final = (b"\xabKTX 11\xbb\r\n", b"\xabKTX 20\xbb\r\n")


class EncodeOptions(msgspec.Struct, frozen=True):
    """Options of encoding.

    `levels`: add coarser levels. `texture_encoding`: encoding of all levels (`AssetEncoding`): `arrays` decodes
    fastest, `png` is what every library reads, `jpeg` is small and lossy, with `jpeg_quality`, and is not used for
    textures with alpha.
    """

    levels: bool = True
    texture_encoding: str = AssetEncoding.ARRAYS
    jpeg_quality: int = 92


class MeshNote(msgspec.Struct, frozen=True):
    """Result of encoding a mesh."""

    low: Vec3
    high: Vec3
    levels: tuple[MeshLevel, ...]


class TextureNote(msgspec.Struct, frozen=True):
    """Result of encoding a texture."""

    levels: tuple[TextureLevel, ...]


class BlobNote(msgspec.Struct, frozen=True):
    """Result of encoding one asset without levels."""

    address: str
    bytes: int


Note = TypeVar("Note", MeshNote, TextureNote, BlobNote)


@dataclass(frozen=True)
class Work(Generic[Note]):
    """One piece of work: the result depends on `raw` and the options; `make` puts the assets into the store."""

    kind: type[Note]
    raw: Sequence[bytes | memoryview | NDArray[Any]]
    make: Callable[[], Note]


class AssetBuilder:
    """Encoder of meshes, textures and other content into a store.

    `built`, `recalled`: number of pieces of work that were done, and whose result the store already had.
    """

    def __init__(self, store: AssetStore, options: EncodeOptions | None = None, threads: int = 0) -> None:
        self.store = store
        self.options = options or EncodeOptions()
        self.built = 0
        self.recalled = 0
        self._threads = threads or min(8, os.cpu_count() or 1)
        self._salt = msgspec.msgpack.encode((ENCODER_VERSION, self.options))
        self._alone = threading.Lock()

    def run(self, pieces: Sequence[Work[Note]]) -> list[Note]:
        """Return results in the order of `pieces`. Equal content is built once."""
        with ThreadPoolExecutor(self._threads) as pool:
            keys = list(pool.map(self._compute_key, pieces))
            first = dict(zip(keys, pieces, strict=True))
            done = dict(zip(first, pool.map(self._run_one, first.items()), strict=True))
        recalled = [was for _, was in done.values()].count(True)
        self.recalled += recalled
        self.built += len(done) - recalled
        return [done[key][0] for key in keys]

    def mesh_work(self, raw: Sequence[NDArray[Any]], arrays: Callable[[], MeshArrays]) -> Work[MeshNote]:
        """Return the work of encoding a mesh. `raw`: the content that `arrays` computes it from."""
        return Work(MeshNote, raw, lambda: self._encode_mesh(arrays()))

    def texture_work(self, pixels: Pixels, kind: str) -> Work[TextureNote]:
        """Return the work of encoding a texture.

        `pixels` (height, width, channels); cube and skybox have six square faces below each other.
        """
        return Work(
            TextureNote,
            (kind.encode(), repr(pixels.shape).encode(), pixels),
            lambda: self._encode_texture(pixels, kind),
        )

    def blob_work(self, raw: Sequence[bytes | NDArray[Any]], encode: Callable[[], bytes]) -> Work[BlobNote]:
        """Return the work of one asset, with the bytes that `encode` returns."""

        def make() -> BlobNote:
            data = encode()
            return BlobNote(self.store.put(data), len(data))

        return Work(BlobNote, raw, make)

    # --- inside -------------------------------------------------------------------------------------------------------

    def _compute_key(self, piece: Work[Note]) -> str:
        digest = hashlib.sha256(self._salt + piece.kind.__name__.encode())
        for part in piece.raw:
            content = np.ascontiguousarray(part).data if isinstance(part, np.ndarray) else memoryview(part)
            # Lengths and shapes are hashed too, so that different parts or shapes never have the same key.
            digest.update(repr((content.format, content.shape)).encode())
            digest.update(content.cast("B") if content.nbytes else b"")
        return digest.hexdigest()

    def _run_one(self, item: tuple[str, Work[Note]]) -> tuple[Note, bool]:
        key, piece = item
        note = self._read_note(key, piece.kind)
        if note is not None:
            return note, True
        if sum(part.nbytes for part in piece.raw if not isinstance(part, bytes)) > ALONE_BYTES:
            with self._alone:
                note = piece.make()
        else:
            note = piece.make()
        self.store.write_index(key, msgspec.msgpack.encode(note))
        return note, False

    def _read_note(self, key: str, kind: type[Note]) -> Note | None:
        remembered = self.store.read_index(key)
        if remembered is None:
            return None
        try:
            note = msgspec.msgpack.decode(remembered, type=kind)
        except msgspec.DecodeError:  # damaged: built again
            return None
        assets = (note,) if isinstance(note, BlobNote) else note.levels
        return note if all(self.store.mark_used(asset.address, asset.bytes) for asset in assets) else None

    def _encode_mesh(self, mesh: MeshArrays) -> MeshNote:
        levels = [self._store_mesh_level(mesh, encode_mesh(mesh), 0.0)]
        target = mesh.triangles // _COARSER
        while self.options.levels and target >= _FEWEST_TRIANGLES:
            coarse = simplify_mesh(mesh, target)
            if coarse is None:
                break
            target //= _COARSER
            data, rounding = encode_mesh_quantised(coarse[0])
            finer = levels[-1]
            if coarse[0].triangles <= _SAVED * finer.triangles and len(data) <= _SAVED * finer.bytes:
                levels.append(self._store_mesh_level(coarse[0], data, coarse[1] + rounding))
        low, high = _bounding_box(mesh)
        return MeshNote(low, high, tuple(levels))

    def _store_mesh_level(self, mesh: MeshArrays, data: bytes, error: float) -> MeshLevel:
        return MeshLevel(self.store.put(data), len(data), AssetEncoding.ARRAYS, mesh.vertices, mesh.triangles, error)

    def _encode_texture(self, pixels: Pixels, kind: str) -> TextureNote:
        if pixels.shape[2] not in (1, 3, 4) or _is_container(pixels):
            data = pixels.tobytes()
            level = TextureLevel(
                self.store.put(data), len(data), AssetEncoding.OPAQUE, pixels.shape[1], pixels.shape[0]
            )
            return TextureNote((level,))
        faces = 1 if kind == TextureKind.IMAGE else 6
        levels = [self._store_texture_level(pixels, faces)]
        while (
            self.options.levels
            and min(pixels.shape[0] // faces, pixels.shape[1]) >= 2 * _SMALLEST_SIDE
            and (faces == 1 or pixels.shape[1] % 2 == 0)
        ):
            pixels = halve(pixels)
            levels.append(self._store_texture_level(pixels, faces))
        return TextureNote(tuple(levels))

    def _store_texture_level(self, pixels: Pixels, faces: int) -> TextureLevel:
        encoding = self.options.texture_encoding
        if encoding == AssetEncoding.JPEG and pixels.shape[2] == 4:
            encoding = AssetEncoding.PNG
        image = encode_image(pixels, encoding, self.options.jpeg_quality)
        height, width = pixels.shape[0] // faces, pixels.shape[1]
        return TextureLevel(self.store.put(image.data), len(image.data), image.encoding, width, height, image.max_error)


def _is_container(pixels: Pixels) -> bool:
    return pixels.shape[0] == pixels.shape[2] == 1 and pixels[0, :12].tobytes().startswith(_OWN_FORMS)


def _bounding_box(mesh: MeshArrays) -> tuple[Vec3, Vec3]:
    if not mesh.vertices:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    low, high = mesh.position.min(axis=0).tolist(), mesh.position.max(axis=0).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
