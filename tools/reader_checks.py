"""Run by `tools/readers.py` in an environment with LeRobot and robomimic: compare a set with what was exported.

    python reader_checks.py lerobot|robomimic|mcap SET EXPECTED.npz [--numbers-only]

Prints one JSON object: `difference`, empty if there is none. It imports nothing of ours.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

#: A picture is that of its frame if it differs from the one that was drawn by less than this, in 1/255 on average.
MOST_PICTURE_ERROR = 6.0


def split_episodes(expected: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what is expected of each episode; pictures are left out."""
    found: dict[int, dict[str, Any]] = {}
    for name, value in expected.items():
        episode, _, key = name.partition("|")
        if "|" not in key:
            found.setdefault(int(episode), {})[key] = value
    return [found[i] for i in sorted(found)]


def find_lerobot_difference(folder: Path, expected: dict[str, Any], numbers_only: bool) -> str:
    """Return the first difference, empty if there is none."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from pyarrow import parquet

    data = LeRobotDataset("local/set", root=folder, video_backend="pyav")
    frames: dict[int, list[dict[str, Any]]] = {}
    exact = {i: parquet.read_table(path) for i, path in enumerate(sorted(folder.glob("data/*/*.parquet")))}
    episodes = split_episodes(expected)
    if data.num_episodes != len(episodes):
        return f"{data.num_episodes} episodes, not {len(episodes)}"
    if numbers_only:
        data.meta.info["features"] = {k: f for k, f in data.meta.features.items() if f["dtype"] != "video"}
    for i in range(len(data)):
        item = data[i]
        frames.setdefault(int(item["episode_index"]), []).append(item)
    for i, given in enumerate(episodes):
        columns = {key: value for key, value in given.items() if key != "states"}
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


def find_robomimic_difference(folder: Path, expected: dict[str, Any], numbers_only: bool) -> str:
    """Return the first difference of what robomimic's `SequenceDataset` gives."""
    import h5py
    from robomimic.utils import obs_utils
    from robomimic.utils.dataset import SequenceDataset

    path, episodes = str(folder / "dataset.hdf5"), split_episodes(expected)
    numbers = [key for key in episodes[0] if not key.endswith(".action") and key not in ("states", "label", "task")]
    cameras = sorted({name.split("|")[1].rpartition(".")[2] for name in expected if "|observation.images." in name})
    images = [] if numbers_only else [f"{camera}_image" for camera in cameras]
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": numbers, "rgb": images}})
    data = SequenceDataset(path, (*numbers, *images), ("actions_ctrl", "states", "actions", "rewards", "dones"))
    if data.n_demos != len(episodes):
        return f"{data.n_demos} episodes, not {len(episodes)}"
    with h5py.File(path) as file:
        attributes = [dict(file[f"data/demo_{i}"].attrs) for i in range(len(episodes))]
        low, high = file["data"].attrs["action_low"], file["data"].attrs["action_high"]
    for i, columns in enumerate(episodes):
        loaded = data.get_trajectory_at_index(i)
        if (attributes[i]["label"], attributes[i]["task"]) != (str(columns["label"]), str(columns["task"])):
            return f"episode {i} has the label {attributes[i]['label']}, task {attributes[i]['task']}"
        commands = np.concatenate([one for key, one in columns.items() if key.endswith(".action")], axis=1)
        scaled = np.clip(2.0 * (commands - low) / np.where(high > low, high - low, 1.0) - 1.0, -1.0, 1.0)
        pairs = {
            "states": columns["states"],
            "actions_ctrl": commands,
            "actions": np.where(high > low, scaled, commands),
        }
        for key, values in pairs.items():
            if np.asarray(loaded[key]).tobytes() != values.tobytes():
                return f"{key} of episode {i} differs"
        for key in numbers:
            values = columns[key]
            if np.asarray(loaded["obs"][key]).tobytes() != values.tobytes():
                return f"{key} of episode {i} differs"
            if np.asarray(loaded["next_obs"][key]).tobytes() != np.concatenate([values[1:], values[-1:]]).tobytes():
                return f"{key} of episode {i} differs in next_obs"
        for name, drawn in expected.items() if images else ():
            if name.startswith(f"{i}|observation.images."):
                _, key, frame = name.split("|")
                if loaded["obs"][f"{key.rpartition('.')[2]}_image"][int(frame)].tobytes() != drawn.tobytes():
                    return f"{key} of episode {i}, frame {frame}, differs"
    return ""


def find_mcap_difference(folder: Path, expected: dict[str, Any], numbers_only: bool) -> str:
    """Return the first difference of what the reader of MCAP gives. Pictures: their number."""
    from mcap.reader import make_reader

    listed, episodes = json.loads((folder / "episodes.json").read_bytes()), split_episodes(expected)
    fps = json.loads((folder / "iris-session.json").read_bytes())["fps"]
    if len(listed) != len(episodes):
        return f"{len(listed)} episodes, not {len(episodes)}"
    cameras = {name.split("|")[1].rpartition(".")[2] for name in expected if "|observation.images." in name}
    for i, columns in enumerate(episodes):
        messages: dict[str, list[Any]] = {}
        with (folder / listed[i]["file"]).open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for _, channel, message in reader.iter_messages():
                messages.setdefault(channel.topic, []).append(message)
            (metadata,) = reader.iter_metadata()
        if (metadata.metadata["label"], metadata.metadata["task"]) != (str(columns["label"]), str(columns["task"])):
            return f"episode {i} has another label or task"
        for key, values in columns.items():
            if key in ("states", "label", "task"):
                continue
            owner, _, name = key.rpartition(".")
            found = messages["/" + owner.replace(".", "/", 1) if owner else "/time"]
            stored = np.array([json.loads(one.data)[name] for one in found], values.dtype)
            if stored.tobytes() != values.tobytes():
                return f"{key} of episode {i} differs"
        n = len(columns["sim_time_s"])
        counts = {topic: len(messages.get(topic, ())) for topic in ("/tf", *(f"/cameras/{one}" for one in cameras))}
        if set(counts.values()) != {n}:
            return f"episode {i} has {counts} messages, not {n}"
        if [one.log_time for one in messages["/tf"]] != [k * 1_000_000_000 // fps for k in range(n)]:
            return f"times of episode {i} differ"
    return ""


CHECKS = {
    "lerobot": find_lerobot_difference,
    "robomimic": find_robomimic_difference,
    "mcap": find_mcap_difference,
}

if __name__ == "__main__":
    with np.load(sys.argv[3]) as arrays:
        values = {key: arrays[key] for key in arrays.files}
    difference = CHECKS[sys.argv[1]](Path(sys.argv[2]), values, "--numbers-only" in sys.argv)
    print(json.dumps({"difference": difference}))
