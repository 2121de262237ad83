"""Files of golden vectors: JSON with one vector per line, so that a change shows which of them it changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def render_vectors(content: Mapping[str, Any], nested: str = "") -> str:
    """Return the text of a file of golden vectors.

    Args:
        content: Values by name; of a list, each item has a line of its own.
        nested: Key of the items that holds a list itself, whose items have the lines. It is their last.
    """
    blocks = []
    for name, value in content.items():
        if isinstance(value, list):
            rows = (_render_nested(row, nested) if nested else "    " + _dump_json(row) for row in value)
            blocks.append(f"  {_dump_json(name)}: [\n" + ",\n".join(rows) + "\n  ]")
        else:
            blocks.append(f"  {_dump_json(name)}: {_dump_json(value)}")
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def _render_nested(row: Mapping[str, Any], nested: str) -> str:
    head = _dump_json({name: value for name, value in row.items() if name != nested})
    items = ",\n".join("      " + _dump_json(item) for item in row[nested])
    return f"    {head[:-1]}, {_dump_json(nested)}: [\n{items}\n    ]}}"


def _dump_json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def to_json_numbers(values: NDArray[Any]) -> list[Any]:
    """Return an array as nested lists. Floats have the value of the float64; those that are not finite are null."""
    plain = values
    if values.dtype.kind == "f":
        plain = values.astype(np.float64).astype(object)
        plain[~np.isfinite(values)] = None
    rows: list[Any] = plain.tolist()
    return rows


def scatter_numbers(n: int) -> NDArray[np.float64]:
    """Return (n,) different numbers in [0, 1) without visible order: multiples of the golden ratio."""
    return np.asarray(np.arange(n) * ((5.0**0.5 - 1.0) / 2.0) % 1.0)
