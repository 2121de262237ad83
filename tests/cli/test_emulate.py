"""`iris-session emulate`: options that are refused before joining."""

from __future__ import annotations

import re

import pytest

from iris_session.cli.main import main


@pytest.mark.parametrize("option", [("--drift", "30"), ("--bump-at", "20"), ("--glance-every", "5")])
def test_options_for_unnamed_headsets_exclude_headset(
    option: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["emulate", "127.0.0.1:1", "--headset", "name=ann", *option]) == 2
    assert "model.drift_m_per_min" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("headset", "pattern"),
    [
        ("name=ann,drift=3", r"'drift'.* T_world_anchor, anchor_id, .*, drift_m_per_min, "),
        ("name=ann,model.drift=3", r"unknown field 'model.drift'; fields: .*model\.drift_m_per_min, "),
        ("name=ann,model.sheet.far=3", r"unknown field 'model.sheet.far'; fields: model\.sheet\.across, "),
        ("name=ann,seed.x=3", "'seed' has no"),
    ],
)
def test_unknown_field_error_lists_fields(headset: str, pattern: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "127.0.0.1:1", "--headset", headset]) == 2
    assert re.search(pattern, capsys.readouterr().err)
