"""Data sets in the layout of LeRobot, version 3.0, closed on the disk episode by episode.

Every episode has files of its own: one of data, one of metadata, one video per camera. So closing one costs what it
costs, however many there are, and none is touched again. The order of writing keeps the set whole at every moment:
videos and data, which nothing names yet; metadata and statistics; `info.json`, whose number of episodes is the truth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import Plan
from iris_session.dataset.files import SetWriter, Stats
from iris_session.dataset.frames import ACTION, BOOL, Schema, Table
from iris_session.dataset.video import CODEC_NAME, PIXELS, compute_stats, make_video_name, merge_stats
from iris_session.system.extras import require_package

VERSION: Final = "v3.0"
#: Files of one kind in a folder.
CHUNK: Final = 1000
#: What LeRobot's own writer would fill a file up to [MB]; ours hold one episode.
DATA_MB: Final = 100
VIDEO_MB: Final = 200
ROBOT_TYPE: Final = "iris-session"
INFO: Final = "meta/info.json"
STATS: Final = "meta/stats.json"
TASKS: Final = "meta/tasks.parquet"
#: What the set is made of: a later run of the same command goes on where this one ended.
REQUEST: Final = "meta/iris-session.json"
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
STATE: Final = "observation.state"
#: Beginning of the key of a camera.
IMAGE: Final = "observation.images."
_FRAME_INDEX: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")


class LeRobotWriter(SetWriter):
    """A set of LeRobot in a folder. Arguments as of `SetWriter`."""

    def __init__(
        self, folder: Path, plan: Plan, schema: Schema, pictures: PictureSpec, request: Mapping[str, Any]
    ) -> None:
        require_package("pyarrow", "writing data sets of LeRobot")
        super().__init__(folder, plan, schema, pictures)
        self._cameras = {one.name: IMAGE + one.name for one in pictures.cameras}
        self._features = _list_features(schema, pictures)
        self._stats: dict[str, Stats] = {}
        self.prepare(REQUEST, request)
        if (folder / INFO).exists():
            self._continue()
        else:
            self._begin(request)

    def _begin(self, request: Mapping[str, Any]) -> None:
        self.write_json(REQUEST, request)
        self._write_table(TASKS, _make_tasks(self.plan.tasks))
        self.write_json(STATS, {})
        self._write_info()

    def _continue(self) -> None:
        """Read how far the set is, and fold the statistics of its episodes again, in their order."""
        from pyarrow import parquet  # type: ignore[import-untyped]

        count = json.loads((self.folder / INFO).read_bytes())["total_episodes"]
        for i in range(count):
            row = parquet.read_table(self.folder / _format(EPISODES_PATH, i)).to_pylist()[0]
            stats: dict[str, Stats] = {}
            for key, value in row.items():
                if key.startswith("stats/"):
                    feature, _, name = key.removeprefix("stats/").rpartition("/")
                    stats.setdefault(feature, {})[name] = np.array(value, np.float64)
            self._add_stats(stats)
            self.n_episodes, self.n_frames = i + 1, row["dataset_to_index"]
            self.note_closed(row["iris/plan_index"], row["iris/look"])

    def close_episode(
        self, index: int, look: int, table: Table, pictures: Mapping[tuple[int, str], Stats], folder: Path
    ) -> None:
        # Docstring and arguments: `SetWriter`.
        number, task = self.n_episodes, self.plan.tasks.index(self.plan.episodes[index].task)
        for camera, key in self._cameras.items():
            self.place(folder / make_video_name(look, camera), _format(VIDEO_PATH, number, video_key=key))
        columns = self._make_columns(table, number, task)
        self._write_table(_format(DATA_PATH, number), _make_table(columns, self._features))
        stats = {key: compute_stats(values) for key, values in columns.items()}
        stats |= {key: pictures[look, camera] for camera, key in self._cameras.items()}
        row = self._make_row(number, index, look, table) | _flatten(stats)
        self._write_table(_format(EPISODES_PATH, number), _make_row_table(row))
        self._add_stats(stats)
        self.n_episodes, self.n_frames = number + 1, self.n_frames + table.n_frames
        self.write_json(STATS, {key: _to_plain(one) for key, one in self._stats.items()})
        self._write_info()

    def _make_columns(self, table: Table, number: int, task: int) -> dict[str, NDArray[Any]]:
        """Return all columns of the data file, each of shape (n, k)."""
        n, given, robots = table.n_frames, table.columns, self.schema.robots
        state: list[NDArray[Any]] = []
        for robot in robots:
            state.append(given[robot.make_key("joint_positions")])
            if robot.has_gripper:
                state.append(given[robot.make_key("gripper")])
        action = [given[robot.make_key(ACTION)] for robot in robots]
        columns: dict[str, NDArray[Any]] = {
            STATE: np.concatenate(state, axis=1).astype(np.float32),
            ACTION: np.concatenate(action, axis=1).astype(np.float32),
            **given,
        }
        frames = np.arange(n, dtype=np.int64)
        own: tuple[NDArray[Any], ...] = (
            *((frames / self.schema.fps).astype(np.float32), frames, np.full(n, number, np.int64)),
            *(self.n_frames + frames, np.full(n, task, np.int64)),
        )
        return columns | {key: values[:, None] for key, values in zip(_FRAME_INDEX, own, strict=True)}

    def _make_row(self, number: int, index: int, look: int, table: Table) -> dict[str, Any]:
        n, (chunk, file) = table.n_frames, divmod(number, CHUNK)
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self.plan.episodes[index].task],
            "length": n,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.n_frames,
            "dataset_to_index": self.n_frames + n,
        }
        for key in self._cameras.values():
            row |= {f"videos/{key}/chunk_index": chunk, f"videos/{key}/file_index": file}
            row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": n / self.schema.fps}
        row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        row |= {f"iris/{key}": value for key, value in self.describe(index, look, table).items() if key != "task"}
        return row | {"iris/first_state": table.states[0]}

    def _add_stats(self, stats: Mapping[str, Stats]) -> None:
        for key, one in stats.items():
            self._stats[key] = merge_stats(self._stats[key], one) if key in self._stats else one

    def _write_info(self) -> None:
        info = {
            "codebase_version": VERSION,
            "robot_type": ROBOT_TYPE,
            "total_episodes": self.n_episodes,
            "total_frames": self.n_frames,
            "total_tasks": len(self.plan.tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self.schema.fps,
            "splits": {"train": f"0:{self.n_episodes}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self._cameras else None,
            "features": self._features,
        }
        self.write_json(INFO, info)

    # --- files --------------------------------------------------------------------------------------------------------

    def _write_table(self, name: str, table: Any) -> None:
        from pyarrow import parquet

        path = self.partial / "file.parquet"
        parquet.write_table(table, path, compression="snappy")
        self.place(path, name)


def _format(pattern: str, number: int, **more: str) -> str:
    chunk, file = divmod(number, CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file, **more)


def _list_features(schema: Schema, pictures: PictureSpec) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns."""
    state, action = [], []
    for robot in schema.robots:
        state += [f"{robot.name}.{joint}" for joint in robot.joints]
        state += [f"{robot.name}.gripper"] if robot.has_gripper else []
        action += [f"{robot.name}.{actuator}" for actuator in robot.actuators]
    features: dict[str, dict[str, Any]] = {
        STATE: {"dtype": "float32", "shape": [len(state)], "names": state},
        ACTION: {"dtype": "float32", "shape": [len(action)], "names": action},
    }
    for column in schema.list_columns():
        features[column.key] = {
            "dtype": column.kind,
            "shape": [len(column.names)],
            "names": list(column.names),
        }
    for key in _FRAME_INDEX:
        features[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
    for camera in pictures.cameras:
        width, height = pictures.get_size(camera)
        features[IMAGE + camera.name] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": CODEC_NAME,
                "video.pix_fmt": PIXELS,
                "video.is_depth_map": False,
                "video.fps": schema.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    return features


def _make_table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return columns as an Arrow table: single numbers, or lists of one length."""
    import pyarrow as pa

    arrays: dict[str, Any] = {}
    for key in features:
        if key in columns:
            values = columns[key]
            flat = pa.array(
                np.ascontiguousarray(values).reshape(-1), pa.bool_() if features[key]["dtype"] == BOOL else None
            )
            size = values.shape[1]
            arrays[key] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(arrays)


def _make_row_table(row: Mapping[str, Any]) -> Any:
    """Return one row as an Arrow table."""
    import pyarrow as pa

    return pa.table({key: [value] for key, value in row.items()})


def _make_tasks(tasks: Sequence[str]) -> Any:
    """Return the table of tasks as pandas writes one whose index is the text."""
    import pyarrow as pa

    index = "__index_level_0__"
    column = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    described = {
        "index_columns": [index],
        "column_indexes": [{"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **column},
            {"name": None, "field_name": index, **text},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _flatten(stats: Mapping[str, Stats]) -> dict[str, Any]:
    """Return statistics as columns of the metadata of an episode."""
    return {f"stats/{key}/{name}": value for key, one in stats.items() for name, value in _to_plain(one).items()}


def _to_plain(stats: Stats) -> dict[str, Any]:
    return {name: [int(value[0])] if name == "count" else value.tolist() for name, value in stats.items()}
