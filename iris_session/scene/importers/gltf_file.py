"""Files of glTF 2.0 and GLB: the document, and the bytes behind it (buffers, accessors, images).

Numbers are finite, and indices and sizes are checked against what is present; other values of a wrong type make the
caller fail, which `files.read_guarded` reports. trimesh would lose what is read here: colours of more than 8 bits,
sparse and normalised accessors, lights, second sets of texture coordinates, children of cameras.
"""

from __future__ import annotations

import base64
import binascii
import codecs
import io
import json
import math
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.references import References, read_bounded
from iris_session.scene.nodes import MAX_FILE_BYTES

_DTYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
#: Integer types that stand for 0..1 or -1..1 when normalised, and the integer that stands for 1.
_ONE: Final = {"i1": 127.0, "u1": 255.0, "i2": 32_767.0, "u2": 65_535.0}
#: Maximum number of values of an accessor without bytes: a file of a few hundred bytes can request any number.
_MAX_ZEROS: Final = 1 << 24
#: Extensions that are drawn as intended; others are listed as left out, or rejected when the file requires them.
KNOWN_EXTENSIONS: Final = frozenset(
    {
        "KHR_lights_punctual",
        "KHR_materials_emissive_strength",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        "EXT_texture_webp",
    }
)


def get_extension(entry: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an entry of the document, empty without it."""
    found: dict[str, Any] = entry.get("extensions", {}).get(name, {})
    return found


class GltfFile:
    """A glTF 2.0 file: its `document`, and the bytes that it refers to. All methods raise `SceneBuildError`."""

    def __init__(self, path: Path, references: References) -> None:
        self.name = path.name
        self._references = references
        data = read_bounded(path)
        if path.suffix.lower() == ".glb" and not data.startswith((b"glTF", b"{", codecs.BOM_UTF8)):
            raise SceneBuildError(
                f"{self.name} is no GLB: it begins with {data[:4]!r} where b'glTF' is needed; export it as glTF binary"
            )
        text, self._chunk = _split_glb(data, path.name) if data[:4] == b"glTF" else (data, None)
        try:
            self.document: dict[str, Any] = json.loads(text, parse_float=_to_finite, parse_constant=_to_finite)
            version = str(self.document["asset"]["version"])
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise SceneBuildError(f"{self.name} is no glTF, or cut: its document cannot be read: {error}") from None
        if not version.startswith("2."):
            raise SceneBuildError(f"{self.name} is no glTF 2.0, but {version!r}: export it again as that")
        unknown = sorted(set(self.document.get("extensionsRequired", ())) - KNOWN_EXTENSIONS)
        if unknown:
            raise SceneBuildError(
                f"{self.name} requires {', '.join(unknown)}: export it without (of meshes: uncompressed)"
            )
        self._buffers: dict[int, bytes] = {}
        self._read = len(data)

    def get(self, kind: str, index: object) -> dict[str, Any]:
        """Return entry `index` of the list `kind` of the document."""
        entries = self.document.get(kind, ())
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise SceneBuildError(f"{self.name} refers to {kind} {index!r}, which it does not have")
        entry: dict[str, Any] = entries[index]
        return entry

    def read_accessor(self, index: object, widths: tuple[int, ...], count: int | None = None) -> NDArray[Any]:
        """Return an accessor.

        Args:
            index: Index of the accessor.
            widths: Numbers of columns that are possible.
            count: Number of rows that it must have.

        Returns:
            Shape (count, width): as floats where it is normalised, otherwise in its own type.
        """
        entry = self.get("accessors", index)
        dtype, width = self._dtype(entry), _WIDTHS.get(entry["type"], 0)
        n = self._size(entry, "count")
        if width not in widths:
            needed = " or ".join(name for name, n in _WIDTHS.items() if n in widths)
            raise SceneBuildError(f"{self.name}: accessor {index} is a {entry['type']!r} where {needed} is needed")
        if count not in (None, n):
            raise SceneBuildError(f"{self.name}: accessor {index} has {n} entries for {count} vertices")
        if "bufferView" in entry:
            values = self._read_rows(entry, dtype, n, width)
        elif n * width > _MAX_ZEROS:
            raise SceneBuildError(f"{self.name}: accessor {index} has {n} entries without bytes")
        else:
            values = np.zeros((n, width), dtype)
        if "sparse" in entry:
            values = self._replace_rows(values, entry["sparse"])
        if entry.get("normalized"):
            values = np.maximum(values / _ONE.get(dtype.str[1:], 1.0), -1.0)
        return values

    def read_image(self, index: object) -> bytes:
        """Return the encoded bytes of an image."""
        image = self.get("images", index)
        return bytes(self._view(image["bufferView"])[0]) if "bufferView" in image else self._read_uri(image.get("uri"))

    # --- internal -----------------------------------------------------------------------------------------------------

    def _size(self, entry: dict[str, Any], key: str) -> int:
        """Return a number of bytes or entries, 0 by default."""
        value = entry.get(key, 0)
        if type(value) is not int or value < 0:
            raise SceneBuildError(f"{self.name}: {key} is {value!r}: a whole number of 0 or more is needed")
        return value

    def _dtype(self, entry: dict[str, Any]) -> np.dtype[Any]:
        if entry["componentType"] not in _DTYPES:
            raise SceneBuildError(f"{self.name}: componentType is {entry['componentType']!r}, not one of {[*_DTYPES]}")
        return np.dtype(_DTYPES[entry["componentType"]])

    def _replace_rows(self, values: NDArray[Any], sparse: dict[str, Any]) -> NDArray[Any]:
        """Return `values` with the rows that a sparse accessor replaces."""
        n, dtype = self._size(sparse, "count"), self._dtype(sparse["indices"])
        rows = self._read_rows(sparse["indices"], dtype, n, 1)[:, 0]
        if dtype.kind != "u" or int(rows.max(initial=0)) >= max(len(values), 1):
            raise SceneBuildError(f"{self.name}: a sparse accessor names entries beyond its {len(values)}")
        changed = values.copy()
        changed[rows] = self._read_rows(sparse["values"], values.dtype, n, values.shape[1])
        return changed

    def _read_rows(self, place: dict[str, Any], dtype: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """Return rows of numbers. `place`: has the `bufferView` and the `byteOffset` in it."""
        data, stride = self._view(place["bufferView"])
        offset, row = self._size(place, "byteOffset"), dtype.itemsize * width
        step = stride or row
        if count and (step < row or offset + (count - 1) * step + row > len(data)):
            raise SceneBuildError(
                f"{self.name}: {count} entries lie beyond the end of bufferViews {place['bufferView']}: it is cut"
            )
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (step, dtype.itemsize)).copy()

    def _view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride, 0 when it has none."""
        view = self.get("bufferViews", index)
        start, length, stride = (self._size(view, key) for key in ("byteOffset", "byteLength", "byteStride"))
        whole = self._read_buffer(view["buffer"])
        if start + length > len(whole):
            raise SceneBuildError(f"{self.name}: bufferViews {index} reaches beyond its buffer: the file is cut")
        return memoryview(whole)[start : start + length], stride

    def _read_buffer(self, index: int) -> bytes:
        uri = self.get("buffers", index).get("uri")
        if index not in self._buffers:
            inside = index == 0 and uri is None and self._chunk is not None
            self._buffers[index] = self._chunk if inside and self._chunk is not None else self._read_uri(uri)
        return self._buffers[index]

    def _read_uri(self, uri: object) -> bytes:
        """Return the bytes behind a URI; the total per file is bounded."""
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


def _to_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text}, which is not finite")
    return value


def _split_glb(data: bytes, name: str) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a GLB."""
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
