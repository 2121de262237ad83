"""Run by `tools/readers.py` in an environment with LeRobot: compare a set as it loads with what was exported.

    python reader_checks.py SET EXPECTED.npz [--numbers-only]

Prints one JSON object: `difference`, empty if there is none. It imports nothing of ours.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from pyarrow import parquet

#: A picture is that of its frame if it differs from the one that was drawn by less than this, in 1/255 on average.
MOST_PICTURE_ERROR = 6.0


def find_difference(folder: Path, expected: dict[str, Any], numbers_only: bool) -> str:
    """Return the first difference, empty if there is none."""
    data = LeRobotDataset("local/set", root=folder, video_backend="pyav")
    frames: dict[int, list[dict[str, Any]]] = {}
    exact = {i: parquet.read_table(path) for i, path in enumerate(sorted(folder.glob("data/*/*.parquet")))}
    episodes = sorted({int(key.partition("|")[0]) for key in expected})
    if data.num_episodes != len(episodes):
        return f"{data.num_episodes} episodes, not {len(episodes)}"
    if numbers_only:
        data.meta.info["features"] = {k: f for k, f in data.meta.features.items() if f["dtype"] != "video"}
    for i in range(len(data)):
        item = data[i]
        frames.setdefault(int(item["episode_index"]), []).append(item)
    for i in episodes:
        columns = {key.split("|")[1]: value for key, value in expected.items() if key.split("|")[0] == str(i)}
        row = data.meta.episodes[i]
        n = len(columns["sim_time_s"])
        if (row["length"], len(frames[i])) != (n, n):
            return f"episode {i} has {row['length']} and {len(frames[i])} frames, not {n}"
        if row["iris/label"] != str(columns.pop("label")):
            return f"episode {i} has the label {row['iris/label']}"
        task = str(columns.pop("task"))
        if any(item["task"] != task for item in frames[i]) or row["tasks"] != [task]:
            return f"episode {i} has another task"
        columns |= make_vectors(data.meta.features, columns)
        for key, values in columns.items():
            if key.startswith("observation.images."):
                continue
            stored = np.array(exact[i].column(key).to_pylist()).reshape(n, -1)
            if stored.astype(values.dtype).tobytes() != values.tobytes():
                return f"{key} of episode {i} differs in the file"
            loaded = np.stack([item[key].numpy().reshape(-1) for item in frames[i]])
            if loaded.tobytes() != values.astype(loaded.dtype).tobytes():
                return f"{key} of episode {i} differs as it is loaded"
        times = np.array([float(item["timestamp"]) for item in frames[i]])
        if not np.array_equal(times.astype(np.float32), (np.arange(n) / data.fps).astype(np.float32)):
            return f"timestamp of episode {i} differs"
    return "" if numbers_only else find_picture_difference(frames, expected)


def make_vectors(features: dict[str, Any], columns: dict[str, Any]) -> dict[str, Any]:
    """Return the vectors of policies, put together anew from the exact columns by the names of their numbers."""
    found = {}
    for vector, parts in (("observation.state", ("joint_positions", "gripper")), ("action", ("action",))):
        names = features[vector]["names"]
        robots = list(dict.fromkeys(name.partition(".")[0] for name in names))
        values = [columns[key] for robot in robots for part in parts if (key := f"robots.{robot}.{part}") in columns]
        found[vector] = np.concatenate(values, axis=1).astype(np.float32)
        assert found[vector].shape[1] == len(names)
    return found


def find_picture_difference(frames: dict[int, list[dict[str, Any]]], expected: dict[str, Any]) -> str:
    for name, drawn in expected.items():
        if "|observation.images." not in name:
            continue
        episode, key, frame = name.split("|")
        loaded = frames[int(episode)][int(frame)][key].numpy().transpose(1, 2, 0) * 255.0
        error = float(np.abs(loaded - drawn).mean())
        if loaded.shape != drawn.shape or error > MOST_PICTURE_ERROR:
            return f"{key} of episode {episode}, frame {frame}, differs by {error:.1f} on average"
    return ""


if __name__ == "__main__":
    with np.load(sys.argv[2]) as arrays:
        values = {key: arrays[key] for key in arrays.files}
    print(json.dumps({"difference": find_difference(Path(sys.argv[1]), values, "--numbers-only" in sys.argv)}))
