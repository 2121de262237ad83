"""The container of a glTF file (2.0): its document, and the bytes, arrays and pictures that the document refers to.

Read here and not by trimesh, which rounds colours to 8 bits, takes no sparse or normalised accessors, and drops what
hangs below a camera. Everything is checked against the bytes that are there; nothing raises but `SceneBuildError`.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.parts import MAX_FILE_BYTES
from iris_session.scene.references import References, read_bounded

_TYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BOM: Final = b"\xef\xbb\xbf"
#: Whole numbers that stand for 0..1 or -1..1, and what 1 is.
_ONE: Final = {"i1": 127.0, "u1": 255.0, "i2": 32_767.0, "u2": 65_535.0}
#: Most numbers of an accessor that has no bytes of its own: a file of a few hundred bytes can ask for any number.
_MAX_ZEROS: Final = 1 << 24
#: What is drawn as the file means it; others are listed as left out, or refused when the file requires them.
KNOWN_EXTENSIONS: Final = frozenset(
    {
        "KHR_lights_punctual",
        "KHR_materials_emissive_strength",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        "EXT_texture_webp",
    }
)


class GltfData:
    """A document (`json`) with its buffers. Raises `SceneBuildError` for what is no glTF 2.0."""

    def __init__(self, path: Path, references: References) -> None:
        self.name = path.name
        self._references = references
        data = read_bounded(path)
        if path.suffix.lower() == ".glb" and not data.startswith((b"glTF", b"{", _BOM)):
            raise SceneBuildError(
                f"{self.name} is no GLB: it begins with {data[:4]!r} where b'glTF' is needed; export it as glTF binary"
            )
        text, self._chunk = _glb(data, path.name) if data[:4] == b"glTF" else (data, None)
        try:
            self.json: dict[str, Any] = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SceneBuildError(f"{self.name} is no glTF, or cut: its document is no JSON: {error}") from None
        if not isinstance(self.json, dict) or not str(self._version()).startswith("2."):
            raise SceneBuildError(f"{self.name} is no glTF 2.0: export it again as that")
        unknown = sorted(set(map(str, self.json.get("extensionsRequired", ()))) - KNOWN_EXTENSIONS)
        if unknown:
            raise SceneBuildError(
                f"{self.name} requires {', '.join(unknown)}: export it without (of meshes: uncompressed)"
            )
        self._buffers: dict[int, bytes] = {}
        self._read = len(data)

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Entry `index` of the list `kind`."""
        entries = self.json.get(kind, ())
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise SceneBuildError(f"{self.name} refers to {kind} {index!r}, which it does not have")
        entry = entries[index]
        if not isinstance(entry, dict):
            raise SceneBuildError(f"{self.name}: entry {index} of {kind} is no map")
        return entry

    def array(self, accessor: object, widths: tuple[int, ...]) -> NDArray[Any]:
        """An accessor (count, width), normalised where it says so, else in its own type."""
        entry = self.item("accessors", accessor)
        dtype, width = np.dtype(_TYPES.get(entry.get("componentType", 0), "V1")), _WIDTHS.get(entry.get("type", ""), 0)
        count = entry.get("count")
        if dtype.kind == "V" or width not in widths or type(count) is not int or count < 0:
            raise SceneBuildError(f"{self.name}: accessor {accessor} is none of the form that is needed there")
        if "bufferView" in entry:
            values = self._view_array(entry["bufferView"], entry.get("byteOffset", 0), dtype, count, width)
        elif count * width > _MAX_ZEROS:
            raise SceneBuildError(f"{self.name}: accessor {accessor} has {count} entries without bytes")
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in entry:
            values = self._sparse(entry["sparse"], values)
        if entry.get("normalized"):
            values = np.maximum(values / _ONE.get(dtype.str[1:], 1.0), -1.0)
        return values

    def picture_bytes(self, image: object) -> bytes:
        """The encoded bytes of an image."""
        entry = self.item("images", image)
        if "bufferView" in entry:
            return bytes(self._view(entry["bufferView"])[0])
        return self._uri(entry.get("uri"))

    # --- inside -------------------------------------------------------------------------------------------------------

    def _version(self) -> object:
        asset = self.json.get("asset")
        return asset.get("version", "") if isinstance(asset, dict) else ""

    def _sparse(self, sparse: Any, values: NDArray[Any]) -> NDArray[Any]:
        if not isinstance(sparse, dict):
            raise SceneBuildError(f"{self.name}: a sparse accessor is no map")
        count, where, what = (sparse.get(key) for key in ("count", "indices", "values"))
        if type(count) is not int or count < 0 or not isinstance(where, dict) or not isinstance(what, dict):
            raise SceneBuildError(f"{self.name}: a sparse accessor lacks count, indices or values")
        places_type = np.dtype(_TYPES.get(where.get("componentType", 0), "V1"))
        if places_type.kind != "u":
            raise SceneBuildError(f"{self.name}: places of a sparse accessor are no whole numbers")
        places = self._view_array(where.get("bufferView"), where.get("byteOffset", 0), places_type, count, 1)[:, 0]
        if count and int(places.max()) >= len(values):
            raise SceneBuildError(f"{self.name}: a sparse accessor names entry {int(places.max())} of {len(values)}")
        changed = values.copy()
        changed[places] = self._view_array(
            what.get("bufferView"), what.get("byteOffset", 0), values.dtype, count, values.shape[1]
        )
        return changed

    def _view_array(self, view: object, offset: object, dtype: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        data, stride = self._view(view)
        row = dtype.itemsize * width
        step = stride or row
        if type(offset) is not int or offset < 0 or step < row:
            raise SceneBuildError(f"{self.name}: a place in bufferViews {view} is none")
        if count and offset + (count - 1) * step + row > len(data):
            raise SceneBuildError(f"{self.name}: {count} entries lie beyond the end of bufferViews {view}: it is cut")
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (step, dtype.itemsize)).copy()

    def _view(self, index: object) -> tuple[memoryview, int]:
        """Bytes of a view, and the distance of its entries, 0 where it does not say."""
        entry = self.item("bufferViews", index)
        start, length, stride = (entry.get(key, 0) for key in ("byteOffset", "byteLength", "byteStride"))
        whole = self._buffer(entry.get("buffer"))
        if not all(type(n) is int and n >= 0 for n in (start, length, stride)) or start + length > len(whole):
            raise SceneBuildError(f"{self.name}: bufferViews {index} reaches beyond its buffer: the file is cut")
        return memoryview(whole)[start : start + length], stride

    def _buffer(self, index: object) -> bytes:
        entry = self.item("buffers", index)
        assert isinstance(index, int)
        if index not in self._buffers:
            inside = index == 0 and "uri" not in entry and self._chunk is not None
            self._buffers[index] = self._chunk if inside and self._chunk is not None else self._uri(entry.get("uri"))
        return self._buffers[index]

    def _uri(self, uri: object) -> bytes:
        """Bytes of a reference; all of a file's together are bounded."""
        if not isinstance(uri, str):
            raise SceneBuildError(f"{self.name}: a buffer or image says nowhere where its bytes are")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                data = base64.b64decode(body, validate=True) if head.endswith(";base64") else b""
            except (binascii.Error, ValueError) as error:
                raise SceneBuildError(f"{self.name}: bytes in a data: address are damaged: {error}") from None
        else:
            data = read_bounded(self._references.find(uri))
        self._read += len(data)
        if self._read > 2 * MAX_FILE_BYTES:
            raise SceneBuildError(f"{self.name} draws in more than {2 * MAX_FILE_BYTES >> 20} MiB: make it smaller")
        return data


def _glb(data: bytes, name: str) -> tuple[bytes, bytes | None]:
    """Text and binary chunk of a GLB."""
    stream = io.BytesIO(data)
    _, version, length = struct.unpack("<4sII", stream.read(12).ljust(12, b"\0"))
    if version != 2 or length > len(data):
        raise SceneBuildError(f"{name} is a GLB of version {version} with {len(data)} bytes of {length}: it is cut")
    found: dict[bytes, bytes] = {}
    while len(head := stream.read(8)) == 8:
        size, kind = struct.unpack("<I4s", head)
        body = stream.read(size)
        if len(body) != size:
            raise SceneBuildError(f"{name} is cut: a part of {size} bytes has {len(body)}")
        found.setdefault(kind, body)
    if b"JSON" not in found:
        raise SceneBuildError(f"{name} is a GLB without a document")
    return found[b"JSON"], found.get(b"BIN\0")
