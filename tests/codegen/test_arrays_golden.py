"""docs/protocol/arrays.json decodes as stated, also by a reader that follows docs/scene.md literally."""

from __future__ import annotations

import json
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest

from iris_session.scene import AssetDecodeError, decode_arrays
from tools.codegen.arrays_golden import render_golden

FILE = Path(__file__).parents[2] / "docs" / "protocol" / "arrays.json"
CONTENT = json.loads(FILE.read_text())
CODES = {"u1": "B", "i1": "b", "u2": "H", "u4": "I", "f4": "f"}
assets = pytest.mark.parametrize("row", [pytest.param(row, id=row["name"]) for row in CONTENT["assets"]])


def read_by_the_document(data: bytes) -> dict[str, tuple[list[int], list[float]]]:
    """Return shape and values of every array, without numpy."""
    assert data[:4] == b"IRA1"
    (n,) = struct.unpack_from("<I", data, 4)
    at, found = 8 + n, {}
    for info in msgpack.unpackb(data[8:at])["arrays"]:
        plain = data[at : at + info["bytes"]]
        at += info["bytes"]
        if info["codec"] == "deflate":
            plain = zlib.decompress(plain, -15)
        width, count = struct.calcsize(CODES[info["dtype"]]), math.prod(info["shape"])
        assert len(plain) == width * count
        if info["filter"] in ("shuffle", "delta"):
            plain = bytes(plain[k * count + i] for i in range(count) for k in range(width))
        if info["filter"] == "up" and plain:
            row = len(plain) // info["shape"][0]
            back = bytearray(plain)
            for i in range(row, len(back)):
                back[i] = (back[i] + back[i - row]) % 256
            plain = bytes(back)
        values: list[Any] = list(struct.unpack(f"<{count}{CODES[info['dtype']]}", plain))
        if info["filter"] == "delta":
            for i in range(1, count):
                values[i] = (values[i] + values[i - 1]) % 2 ** (8 * width)
            if info["dtype"] == "i1":
                values = [v - 256 if v > 127 else v for v in values]
        if info["scale"]:
            last = info["shape"][-1]
            values = [info["offset"][i % last] + info["scale"][i % last] * v for i, v in enumerate(values)]
        found[info["name"]] = info["shape"], values
    assert at == len(data)
    return found


def expected(array: dict[str, Any]) -> np.ndarray[Any, np.dtype[Any]]:
    values = [math.nan if v is None else v for v in array["values"]]
    return np.array(values, np.dtype(f"<{array['dtype']}")).reshape(array["shape"])


@assets
def test_decoder_agrees_with_the_vector(row: dict[str, Any]) -> None:
    found = decode_arrays(bytes.fromhex(row["hex"]), row["kind"])
    assert list(found) == list(row["arrays"])
    for name, values in found.items():
        wanted = expected(row["arrays"][name])
        assert (values.dtype, values.shape) == (wanted.dtype, wanted.shape)
        if values.dtype.kind == "f":
            np.testing.assert_array_equal(np.where(np.isfinite(values), values, np.float32("nan")), wanted)
        else:
            assert np.array_equal(values, wanted)


@assets
def test_literal_reader_agrees_with_the_vector(row: dict[str, Any]) -> None:
    """Quantised values within a rounding of float32."""
    for name, (shape, values) in read_by_the_document(bytes.fromhex(row["hex"])).items():
        array = row["arrays"][name]
        assert shape == array["shape"]
        for value, wanted in zip(values, array["values"], strict=True):
            assert not math.isfinite(value) if wanted is None else value == pytest.approx(wanted, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("row", [pytest.param(row, id=row["name"]) for row in CONTENT["malformed"]])
def test_malformed_arrays_are_rejected(row: dict[str, Any]) -> None:
    with pytest.raises(AssetDecodeError):
        decode_arrays(bytes.fromhex(row["hex"]), "mesh")


def test_file_is_current() -> None:
    """All but the packed bytes, which depend on the version of zlib."""

    def without_bytes(content: dict[str, Any]) -> list[Any]:
        return [(row["name"], row.get("arrays")) for part in ("assets", "malformed") for row in content[part]]

    assert without_bytes(json.loads(render_golden())) == without_bytes(CONTENT)
