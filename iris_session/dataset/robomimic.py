"""Data sets in the layout of robomimic: HDF5, one file per episode, and one that names them as robomimic reads them.

An HDF5 file that is being written is unreadable after a kill. So an episode is a file of its own, which appears whole,
and `dataset.hdf5` has external links to them and is replaced in one step: it is the truth.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import SUCCESS, Plan
from iris_session.dataset.files import PictureSink, SetWriter, Stats
from iris_session.dataset.formats import MODEL
from iris_session.dataset.frames import ACTION, Schema, Table
from iris_session.replay.pictures import Layer
from iris_session.system.extras import require_package

INDEX: Final = "dataset.hdf5"
REQUEST: Final = "iris-session.json"
EPISODE: Final = "episodes/episode_{:06d}.hdf5"
#: Every so many episodes, one is in the mask `valid`, the others are in `train`.
VALID_EVERY: Final = 10
#: `EnvType.GYM_TYPE` of robomimic: the one that needs nothing but a name until the environment is made.
_GYM: Final = 2
_COMPRESSION: Final = {"compression": "gzip", "compression_opts": 1}


class ArraySink(PictureSink):
    """Pictures of one episode on their way into HDF5, one file per look."""

    def __init__(self, folder: Path, schema: Schema, pictures: PictureSpec) -> None:
        self._folder = folder
        self._files: dict[int, Any] = {}

    def add(self, look: int, camera: str, image: Layer) -> None:
        import h5py

        if look not in self._files:
            self._files[look] = h5py.File(self._folder / make_file_name(look), "w")
        file = self._files[look]
        image = image.reshape(*image.shape[:2], -1)
        name = f"obs/{camera}_image" if image.shape[2] == 3 else f"obs/{camera}"
        if name not in file:
            shape = {"shape": (0, *image.shape), "maxshape": (None, *image.shape), "chunks": (1, *image.shape)}
            file.create_dataset(name, dtype=image.dtype, **shape, **_COMPRESSION)
        data = file[name]
        data.resize(len(data) + 1, axis=0)
        data[-1] = image

    def close(self) -> dict[tuple[int, str], Stats]:
        for file in self._files.values():
            file.close()
        return {}

    def abort(self) -> None:
        self.close()


def make_file_name(look: int) -> str:
    """Return the name of the file of a look while it is made."""
    return f"{look}.hdf5"


class RobomimicWriter(SetWriter):
    """A set of robomimic in a folder. Arguments as of `SetWriter`."""

    def __init__(
        self, folder: Path, plan: Plan, schema: Schema, pictures: PictureSpec, request: Mapping[str, Any]
    ) -> None:
        require_package("h5py", "writing data sets of robomimic")
        super().__init__(folder, plan, schema, pictures)
        self._labels: list[str] = []
        self._ranges = np.array([one for robot in schema.robots for one in robot.ranges]).reshape(-1, 2).T
        self.prepare(REQUEST, request)
        if (folder / INDEX).exists():
            self._continue()
        else:
            self.write_json(REQUEST, request)
            self._write_index()

    def _continue(self) -> None:
        import h5py

        with h5py.File(self.folder / INDEX) as file:
            for i in range(len(file["data"])):
                described = file[f"data/demo_{i}"].attrs
                self._labels.append(str(described["label"]))
                self.note_closed(int(described["plan_index"]), int(described["look"]))
            self.n_episodes, self.n_frames = len(self._labels), int(file["data"].attrs["total"])

    def close_episode(
        self, index: int, look: int, table: Table, pictures: Mapping[tuple[int, str], Stats], folder: Path
    ) -> None:
        # Docstring and arguments: `SetWriter`.
        import h5py

        path, n = folder / make_file_name(look), table.n_frames
        described = self.describe(index, look, table)
        with h5py.File(path, "a") as file:
            file.attrs.update({**described, "num_samples": n, "model": self._place_model(folder / MODEL)})
            actions = [table.columns[robot.make_key(ACTION)] for robot in self.schema.robots]
            commands = np.concatenate(actions, axis=1)
            is_last = np.arange(n) == n - 1
            file["actions"], file["actions_ctrl"] = self._scale(commands), commands
            file["states"] = table.states
            file["dones"] = is_last.astype(np.int64)
            file["rewards"] = (is_last & (described["label"] == SUCCESS)).astype(np.float64)
            for key, values in table.columns.items():
                if not key.endswith(f".{ACTION}"):
                    file[f"obs/{key}"] = values
            for key, data in file["obs"].items():
                _link_next(file, key, data)
        self.place(path, EPISODE.format(self.n_episodes))
        self._labels.append(described["label"])
        self.n_episodes, self.n_frames = self.n_episodes + 1, self.n_frames + n
        self._write_index()

    def _scale(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return commands from -1 to 1 over the range of each actuator, as robomimic wants them; without one, as is."""
        low, high = self._ranges
        has_range = high > low
        span = np.where(has_range, high - low, 1.0)
        scaled = np.clip(2.0 * (commands - low) / span - 1.0, -1.0, 1.0)
        return np.where(has_range, scaled, commands)

    def _place_model(self, path: Path) -> str:
        """Place the model of an episode, unless it is there. Return its name in the set."""
        name = f"models/{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}.mjb"
        if not (self.folder / name).exists():
            self.place(Path(shutil.copy(path, self.partial / MODEL)), name)  # other looks need it, too
        return name

    def _write_index(self) -> None:
        import h5py

        path = self.partial / INDEX
        names = [f"demo_{i}" for i in range(self.n_episodes)]
        masks = {
            label: [n for n, one in zip(names, self._labels, strict=True) if one == label] for label in self._labels
        }
        masks["valid"] = names[VALID_EVERY - 1 :: VALID_EVERY]
        masks["train"] = [name for name in names if name not in set(masks["valid"])]
        environment = {"env_name": "iris-session", "type": _GYM, "env_kwargs": {"fps": self.schema.fps}}
        with h5py.File(path, "w") as file:
            data = file.create_group("data")
            data.attrs.update({"total": self.n_frames, "env_args": json.dumps(environment)})
            data.attrs.update({"action_low": self._ranges[0], "action_high": self._ranges[1]})
            for i, name in enumerate(names):
                data[name] = h5py.ExternalLink(EPISODE.format(i), "/")
            for name, members in masks.items():
                if members:
                    file[f"mask/{name}"] = np.array(members, "S")
        self.place(path, INDEX)


def _link_next(file: Any, key: str, data: Any) -> None:
    """Make `next_obs` of an observation: the one a frame later, and the last again, without a copy of the numbers."""
    import h5py

    layout, source = h5py.VirtualLayout(data.shape, data.dtype), h5py.VirtualSource(".", data.name, data.shape)
    layout.dcpl.set_obj_track_times(False)  # the same bytes at any time
    layout[:-1], layout[-1:] = source[1:], source[-1:]
    file.create_virtual_dataset(f"next_obs/{key}", layout)
