"""Golden vectors of the container of arrays, for tests of this and every other reader.

docs/protocol/arrays.json, written by `python -m tools.codegen arrays`: assets, and the arrays that they decode
to. Packed bytes are those of the zlib that is installed: another may pack otherwise, which decodes to the same.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.assets import ARRAYS_MAGIC, ArrayHeader, ArrayInfo
from iris_session.protocol.names import ArrayCodec, ArrayFilter, ArrayKind
from iris_session.scene.arrays import StoredArray, decode_arrays, encode_arrays
from iris_session.scene.meshes import MeshArrays, encode_mesh, encode_mesh_quantised
from tools.codegen.vectors import render_vectors, to_json_numbers

#: Values of the arrays of every dtype.
_NUMBERS: Final = np.array([[0, 1, 255], [7, 7, 7], [200, 3, 129], [128, 127, 0]])


def iterate_vectors() -> Iterator[tuple[str, str, bytes]]:
    """Return name, kind and bytes of every asset."""
    for filter_kind in (ArrayFilter.NONE, ArrayFilter.SHUFFLE, ArrayFilter.DELTA, ArrayFilter.UP):
        arrays = [
            StoredArray(dtype, values, filter_kind)
            for dtype, values in _make_every_dtype().items()
            if dtype != "f4" or filter_kind != ArrayFilter.DELTA
        ]
        yield f"{filter_kind}: every dtype", ArrayKind.MESH, encode_arrays(ArrayKind.MESH, arrays)
    ramp = np.add.outer(np.arange(32), np.arange(24)).astype(np.uint8)[:, :, None].repeat(3, axis=2)
    for filter_kind in (ArrayFilter.NONE, ArrayFilter.UP):
        image = encode_arrays(ArrayKind.IMAGE, [StoredArray("pixels", ramp, filter_kind)])
        yield f"{filter_kind}: an image, packed", ArrayKind.IMAGE, image
    mesh = _make_mesh()
    yield "a mesh, exact", ArrayKind.MESH, encode_mesh(mesh)
    yield "a mesh, quantised", ArrayKind.MESH, encode_mesh_quantised(mesh)[0]
    coloured = replace(mesh, uv=None, color=_make_colors(mesh.vertices))
    yield "a mesh with colours at its corners, exact", ArrayKind.MESH, encode_mesh(coloured)
    yield "a mesh with colours at its corners, quantised", ArrayKind.MESH, encode_mesh_quantised(coloured)[0]
    empty = [
        StoredArray("index", np.zeros((0, 3), np.uint16), ArrayFilter.DELTA),
        StoredArray("position", np.zeros((0, 3), "f4")),
    ]
    yield "arrays of nothing", ArrayKind.MESH, encode_arrays(ArrayKind.MESH, empty)
    yield "no arrays", ArrayKind.MESH, encode_arrays(ArrayKind.MESH, [])


def iterate_malformed() -> Iterator[tuple[str, bytes]]:
    """Return name and bytes of the cases that a reader must reject as an asset of kind `mesh`."""
    good = encode_arrays(ArrayKind.MESH, [StoredArray("a", np.zeros(200, np.uint8))])
    yield "empty", b""
    yield "another magic", b"IRA2" + good[4:]
    yield "truncated", good[:-1]
    yield "a byte too many", good + b"\x00"
    yield "a header of 4 GB", ARRAYS_MAGIC + b"\xff\xff\xff\xff" + good[8:]
    infos = {
        "packed bytes of another size than the array": ArrayInfo("a", "u1", (201,), 0, codec=ArrayCodec.DEFLATE),
        "an array of 2^62 bytes": ArrayInfo("a", "u1", (2**31, 2**31), 0, codec=ArrayCodec.DEFLATE),
        "nothing along one axis, 2^62 along another": ArrayInfo("a", "u1", (0, 2**62), 0),
        "an unknown dtype": ArrayInfo("a", "f8", (25,), 0),
        "an unknown filter": ArrayInfo("a", "u1", (200,), 0, "wavelet"),
        "an unknown codec": ArrayInfo("a", "u1", (200,), 0, codec="lzma"),
        "differences of floats": ArrayInfo("a", "f4", (50,), 0, ArrayFilter.DELTA),
        "fewer bytes than the shape": ArrayInfo("a", "u1", (300,), 0),
        "scale of another length": ArrayInfo("a", "u1", (200,), 0, scale=(1.0,), offset=(0.0,)),
    }
    packed = zlib.compress(bytes(200), wbits=-15)
    for name, info in infos.items():
        body = packed if info.codec != ArrayCodec.NONE else bytes(200)
        if 0 in info.shape:
            body = b""
        yield name, _pack_asset(ArrayHeader(ArrayKind.MESH, (msgspec.structs.replace(info, bytes=len(body)),)), body)
    yield "another kind", encode_arrays(ArrayKind.IMAGE, [])
    twice = ArrayInfo("a", "u1", (1,), 1)
    yield "two arrays of one name", _pack_asset(ArrayHeader(ArrayKind.MESH, (twice, twice)), b"ab")


def build_golden() -> dict[str, Any]:
    """Return the content of the file. Values are flat, in C order: integers, or floats with the value of the float32,
    null where they are not finite."""
    assets = []
    for name, kind, data in iterate_vectors():
        arrays = {
            array_name: {
                "dtype": values.dtype.str.lstrip("<|"),
                "shape": list(values.shape),
                "values": to_json_numbers(values.ravel()),
            }
            for array_name, values in decode_arrays(data, kind).items()
        }
        assets.append({"name": name, "kind": kind, "hex": data.hex(), "arrays": arrays})
    malformed = [{"name": name, "hex": data.hex()} for name, data in iterate_malformed()]
    return {"format": 1, "assets": assets, "malformed": malformed}


def render_golden() -> str:
    """Return the text of the file."""
    return render_vectors(build_golden())


def _make_every_dtype() -> dict[str, NDArray[Any]]:
    wide = _NUMBERS * 0x01010101 % 2**32
    floats = np.array([[0.0, -0.0, 1.5], [-2.25e-3, 3.4e38, 1e-45], [np.nan, np.inf, -np.inf], [1, 2, 3]], "<f4")
    return {
        "u1": _NUMBERS.astype("u1"),
        "i1": _NUMBERS.astype("u1").view("i1"),
        "u2": (wide & 0xFFFF).astype("<u2"),
        "u4": wide.astype("<u4"),
        "f4": floats,
    }


def _make_mesh() -> MeshArrays:
    """Return a textured strip of a cylinder."""
    angle, z = (part.ravel() for part in np.meshgrid(np.linspace(0, 1.5, 8), np.linspace(0, 0.3, 4), indexing="ij"))
    position = np.stack([np.cos(angle), np.sin(angle), z], axis=1).astype("f4")
    normal = (position * [1, 1, 0]).astype("f4")
    uv = np.stack([angle / 1.5, 1 - z / 0.3], axis=1).astype("f4")
    corner = np.arange(32, dtype=np.uint32).reshape(8, 4)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    index = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return MeshArrays(position, normal, uv, index)


def _make_colors(corners: int) -> NDArray[np.uint8]:
    """Return colours from red to blue, less and less opaque."""
    along = np.linspace(0, 255, corners).round().astype(np.uint8)
    return np.stack([255 - along, along // 2, along, 255 - along // 4], axis=1)


def _pack_asset(header: ArrayHeader, body: bytes) -> bytes:
    head = msgspec.msgpack.encode(header)
    return ARRAYS_MAGIC + len(head).to_bytes(4, "little") + head + body
