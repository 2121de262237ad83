"""The whole headset app on stand-ins of the engine, with a live session on another machine."""

from __future__ import annotations

import json
import subprocess
from typing import Final

import pytest

from tests.csharp.conftest import built as built  # noqa: PLC0414  a fixture
from tests.e2e.session_process import DEADLINE_S
from tests.e2e.test_csharp import DRAW_CALLS, DRAWN_MM, MOVE_MM, pair, serve
from tests.e2e.test_csharp import network as network  # noqa: PLC0414  a fixture
from tests.e2e.virtual_network import Network
from tools.csharp.project import Build

# Long: the wearer walks and reaches in real time.
pytestmark = [pytest.mark.e2e, pytest.mark.long]

#: What an alignment by exact sheets may be away from the true one [mm].
ALIGNED_MM: Final = 20.0


def test_the_app_pairs_draws_is_aligned_and_moves_an_arm(network: Network, built: Build) -> None:
    serve(network, "aloha")
    link = f"https://10.77.1.1:7725/#c={pair(network)}"
    folder = network.headset.folder / "app"
    program = [*built.make_command("dotnet", "app"), "run", str(folder), link, "ann", "north/right"]
    done = subprocess.run(
        network.headset.wrap_command(*program),
        env=network.headset.environment(),
        capture_output=True,
        text=True,
        timeout=4 * DEADLINE_S,
        check=False,
    )
    lines = {line["command"]: line for line in map(json.loads, done.stdout.splitlines())}
    assert done.returncode == 0, done.stdout + done.stderr
    assert lines["align"]["true_mm"] <= ALIGNED_MM
    assert "sheet" in lines["align"]["words"], "before it, the wearer reads what to look at"
    assert lines["draw"]["error_mm"] <= DRAWN_MM
    assert 0 < lines["draw"]["draws"] <= DRAW_CALLS
    assert lines["acquire"]["words"] == "north/right", "the ray is at the arm"
    assert lines["move"]["error_mm"] <= MOVE_MM
    assert {"join", "estop", "leave"} <= {*lines}
