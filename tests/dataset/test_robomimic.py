"""Sets of robomimic: every column as it was read, pictures, depth and masks, actions in the range of the actuators."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np
import pytest

from iris_session.dataset.cameras import CameraSet, PictureSpec, parse_cameras
from iris_session.dataset.episodes import PlanOptions, make_plan
from iris_session.dataset.frames import FrameReader, Table, make_schema
from iris_session.dataset.run import DatasetOptions, export_dataset
from iris_session.recording import Recording
from iris_session.session.core import SessionCore
from tests.dataset.support import record
from tests.replay.support import Played

PICTURES = PictureSpec(parse_cameras("operator"), 64, 48, plain=True, depth=True, masks=True)
OPTIONS = DatasetOptions(100, PICTURES, PlanOptions(("success", "failure")))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def load(folder: Path) -> list[dict[str, Any]]:
    """Read a set through `dataset.hdf5`, as robomimic does. Return attributes and arrays of each episode."""
    if not (folder / "dataset.hdf5").exists():
        return []
    found = []
    with h5py.File(folder / "dataset.hdf5") as file:
        for i in range(len(file["data"])):
            demo = file[f"data/demo_{i}"]
            arrays: dict[str, Any] = {}
            demo.visititems(lambda key, one, into=arrays: into.update({key: one[:]}) if hasattr(one, "shape") else None)
            assert all(len(one) == demo.attrs["num_samples"] for one in arrays.values())
            found.append({**demo.attrs, **arrays})
        assert sum(one["num_samples"] for one in found) == file["data"].attrs["total"]
    return found


def read_tables(played: Played, pictures: PictureSpec = PICTURES) -> list[tuple[Table, dict[str, list[Any]]]]:
    """Return frames and pictures of the episodes as they were in the session."""
    plan, found = make_plan([played.path], OPTIONS.choice), []
    with Recording.open(played.path, warn=False) as recording, CameraSet(pictures) as cameras:
        reader = FrameReader(recording, plan.recordings[0], make_schema(played.core, OPTIONS.fps))
        for episode in plan.episodes:
            images: dict[str, list[Any]] = {}

            def draw(core: SessionCore, images: dict[str, list[Any]] = images) -> None:
                for _, name, image in cameras.draw(core, recording):
                    images.setdefault(name, []).append(image.copy())

            found.append((reader.read(episode, draw), images))
    return found


def test_a_set_holds_what_was_read(played: Played, tmp_path: Path) -> None:
    report = export_dataset([played.path], tmp_path / "set", "robomimic", OPTIONS)
    assert (report.episodes, report.frames) == (3, 30)
    demos = load(tmp_path / "set")
    for demo, (table, images), label in zip(demos, read_tables(played), ("success", "failure", "success"), strict=True):
        assert (demo["label"], demo["episode"]) == (label, demos.index(demo) + 1)
        for key, values in table.columns.items():
            if not key.endswith(".action"):
                assert demo[f"obs/{key}"].tobytes() == values.tobytes()
                assert demo[f"next_obs/{key}"].tobytes() == np.concatenate([values[1:], values[-1:]]).tobytes()
        commands = np.concatenate([values for key, values in table.columns.items() if key.endswith(".action")], axis=1)
        assert demo["actions_ctrl"].tobytes() == commands.tobytes()
        assert demo["states"].tobytes() == table.states.tobytes()
        assert demo["dones"].tolist() == [*[0] * (table.n_frames - 1), 1]
        assert demo["rewards"].sum() == (label == "success")
        for key, name in (("operator", "operator_image"), ("operator_depth",) * 2, ("operator_mask",) * 2):
            assert demo[f"obs/{name}"].tobytes() == np.array(images[key]).tobytes()
        model = mujoco.MjModel.from_binary_path(str(tmp_path / "set" / demo["model"]))
        assert mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION)) == table.states.shape[1]
    with h5py.File(tmp_path / "set/dataset.hdf5") as file:
        assert file["mask/failure"][:].tolist() == [b"demo_1"]
        assert file["mask/train"][:].tolist() == [b"demo_0", b"demo_1", b"demo_2"]
        low, high = file["data"].attrs["action_low"], file["data"].attrs["action_high"]
    assert (high > low).all()
    for demo in demos:
        assert np.abs(demo["actions"]).max() <= 1.0
        expected = np.clip(demo["actions_ctrl"], low, high)
        assert np.allclose(low + (demo["actions"] + 1.0) / 2.0 * (high - low), expected, atol=1e-12)
