"""The table of robots in model files: what it counts, and that an arm without a site follows a hand by 5 cm."""

from __future__ import annotations

from pathlib import Path

from tests.models import MENAGERIE
from tools.models import examine, format_row, list_model_files, summarise


def test_table_of_files(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text("<mujocoinclude/>")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "empty.xml").write_text("<mujoco/>")
    files = [*list_model_files([tmp_path]), MENAGERIE / "unitree_go1" / "go1.xml"]
    panda = examine(MENAGERIE / "franka_emika_panda" / "panda.xml", move=True)
    rows = [*(examine(file, move=True) for file in files), panda]
    assert summarise(rows) == {
        "files": 4,
        "compile": 3,
        "with_robots": 1,
        "with_notices": 0,
        "arms": 1,
        "hands": 0,
        "moved": 1,
        "moved_within_5_mm": 1,
    }
    assert "arm panda: 7 joints, tip hand[0, 0, 106], gripper actuator8" in "\n".join(format_row(panda))
