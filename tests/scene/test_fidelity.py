"""A model rebuilt from the decoded scene, drawn by MuJoCo, against MuJoCo's picture of the original."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from iris_session.protocol.scene import encode_scene
from iris_session.scene import AssetStore, EncodeOptions
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.models import MENAGERIE
from tests.scene.models import every_shape
from tests.scene.pictures import ModelRenderer, cameras, graphics, silhouette_iou
from tests.scene.rebuild import rebuild

#: Of 255. Edges of textures may fall onto the adjacent pixel, so a few may differ by more than `VISIBLE`.
MEAN_DIFFERENCE, VISIBLE, VISIBLE_SHARE = 0.5, 24, 0.002
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


def check(model: mujoco.MjModel, store: AssetStore, views: slice) -> None:
    parsed = parse_mujoco(model, store, options=EncodeOptions(levels=False))
    assert parsed.skipped == ()
    copy = rebuild(encode_scene(parsed.spec), store)
    pictures = []
    with graphics():
        for one in (model, copy):
            artist = ModelRenderer(one)
            pictures.append([(artist.segments(c), artist.colour(c)) for c in cameras(one)[views]])
            artist.close()
    assert pictures[0]
    solid = np.append(model.geom_type != PLANE, False)  # an infinite floor fills every silhouette
    for (shown, colour), (shown_copy, colour_copy) in zip(*pictures, strict=True):
        assert silhouette_iou(solid[shown], solid[shown_copy]) >= 0.99
        assert np.mean(shown == shown_copy) >= 0.99
        assert colour.std() > 5  # the picture is not empty
        difference = np.abs(colour.astype(np.int16) - colour_copy)
        assert difference.mean() <= MEAN_DIFFERENCE
        assert np.mean(difference.max(axis=2) > VISIBLE) <= VISIBLE_SHARE


@pytest.mark.parametrize(
    ("name", "views"), [pytest.param("aloha", slice(2, 5), marks=pytest.mark.long), ("google_barkour_vb", slice(0, 1))]
)
def test_real_robots_look_the_same(tmp_path: Path, name: str, views: slice) -> None:
    model = mujoco.MjModel.from_xml_path(str(MENAGERIE / name / "scene.xml"))
    check(model, AssetStore(tmp_path), views)


def test_every_shape_material_and_light_looks_the_same(tmp_path: Path) -> None:
    check(every_shape(), AssetStore(tmp_path), slice(None))
