"""docs/protocol/arrays.json decodes as stated. The decoders in TypeScript and C# have the same vectors."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session.scene import AssetDecodeError, decode_arrays
from tools.codegen.arrays_golden import render_golden

FILE = Path(__file__).parents[2] / "docs" / "protocol" / "arrays.json"
CONTENT = json.loads(FILE.read_text())
assets = pytest.mark.parametrize("row", [pytest.param(row, id=row["name"]) for row in CONTENT["assets"]])


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


@pytest.mark.parametrize("row", [pytest.param(row, id=row["name"]) for row in CONTENT["malformed"]])
def test_malformed_arrays_are_rejected(row: dict[str, Any]) -> None:
    with pytest.raises(AssetDecodeError):
        decode_arrays(bytes.fromhex(row["hex"]), "mesh")


def test_file_is_current() -> None:
    """All but the packed bytes, which depend on the version of zlib."""

    def without_bytes(content: dict[str, Any]) -> list[Any]:
        return [(row["name"], row.get("arrays")) for part in ("assets", "malformed") for row in content[part]]

    assert without_bytes(json.loads(render_golden())) == without_bytes(CONTENT)
