"""glTF documents made by hand, to cover every corner of the format."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_CODES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
#: Four corners of a square of side 2 in x and y.
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
SQUARE_INDEX = np.array([0, 1, 2, 0, 2, 3], np.uint16)
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


class Document:
    """`json` may be changed freely before `write`."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "meshes": []}

    def view(self, data: bytes) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)})
        self.blob += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any], **more: Any) -> int:
        rows = values.reshape(len(values), -1)
        entry = {
            "bufferView": self.view(values.tobytes()),
            "componentType": _CODES[str(values.dtype)],
            "count": len(rows),
            "type": _TYPES[rows.shape[1]],
            **more,
        }
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def square(self, material: int | None = None, **attributes: int) -> int:
        """A mesh with one primitive."""
        primitive: dict[str, Any] = {
            "attributes": {"POSITION": self.accessor(SQUARE), **attributes},
            "indices": self.accessor(SQUARE_INDEX),
        }
        if material is not None:
            primitive["material"] = material
        self.json["meshes"].append({"primitives": [primitive]})
        return len(self.json["meshes"]) - 1

    def image(self, pixels: NDArray[np.uint8]) -> int:
        """A texture of its own image; returns the texture's number."""
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "PNG")
        self.json.setdefault("images", []).append({"bufferView": self.view(data.getvalue()), "mimeType": "image/png"})
        self.json.setdefault("textures", []).append({"source": len(self.json["images"]) - 1})
        return len(self.json["textures"]) - 1

    def write(self, path: Path) -> Path:
        document = {**self.json, "buffers": [{"byteLength": len(self.blob)}]}
        document.setdefault("nodes", [{"mesh": k} for k in range(len(self.json["meshes"]))])
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self.blob) + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path
