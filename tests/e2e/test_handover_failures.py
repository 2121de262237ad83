"""Front and recorder are killed while two emulated people hand a hammer over: they finish it, nothing is lost."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

import pytest

from iris_session.protocol.server_messages import Handover
from tests.e2e.conftest import Stage

pytestmark = pytest.mark.e2e


def test_operators_finish_though_recorder_and_front_were_killed(
    stage: Stage, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    watcher = stage.join("watcher", "observer")
    people = emulate(
        stage.server.address, "name=ann,behaviour=giver,robot=left", "name=bob,behaviour=receiver,robot=right"
    )

    def hammer() -> float:
        return stage.height("watcher", "hammer")

    stage.run(lambda: hammer() > 0.0, "a first picture")
    table = hammer()
    stage.run(lambda: hammer() > table + 0.02, "ann begins to lift the hammer", 60.0)
    holders = {name: watcher.mirror.leases[name].holder for name in ("left", "right")}
    stage.server.children()["recording.process"].kill()
    stage.run(lambda: hammer() > table + 0.06, "the hammer is in the air")
    stage.server.children()["front.main"].kill()
    stage.run(lambda: watcher.connection.counters.reconnects > 0 and watcher.ready, "the watcher is back")
    stage.run(lambda: "Handover" in stage.bodies("watcher"), "the hammer changes hands", 60.0)
    (event,) = [e.body for e in stage.events["watcher"] if isinstance(e.body, Handover)]
    assert (event.giver_participant, event.receiver_participant) == (holders["left"], holders["right"])
    assert people.poll() is None
    report = stage.server.finish()
    assert report["parts"] == 2
    assert report["gaps"] == []
    assert report["finished"]
