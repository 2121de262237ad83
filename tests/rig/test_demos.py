"""Emulated people do the work of the demos in simulated time: what depends on skill and luck has a fixed seed."""

from __future__ import annotations

from iris_session.protocol.server_messages import Handover
from tests.rig.session import Rig


def test_hammer_is_handed_over_over_busy_wifi_although_the_front_was_killed_while_it_was_in_the_air() -> None:
    with Rig(profile="busy-wifi", timestep=0.006) as rig:
        quick = {"viewpoints": 3, "observations_per_viewpoint": 4}
        ann = rig.emulate(name="ann", behaviour="giver", robot="left", seed=1, **quick)
        bob = rig.emulate(name="bob", behaviour="receiver", robot="right", seed=2, **quick)
        watcher = rig.join("watcher", "observer")

        def height() -> float:
            state = watcher.scene.state
            return 0.0 if state is None else float(state.poses[watcher.mirror.body_index["hammer"]][2])

        rig.run_until(lambda: height() > 0.0, "a first state")
        table = height()
        rig.run_until(lambda: height() > table + 0.06, "ann lifts the hammer")
        rig.kill_front()
        rig.run_until(lambda: ann.finished and bob.finished, "both are done", 60.0)
        assert (ann.report.phase, bob.report.phase) == ("done", "done"), (ann.report.failed, bob.report.failed)
        (event,) = [e.body for e in rig.events["watcher"] if isinstance(e.body, Handover)]
        assert (event.object, event.giver_participant) == ("hammer", ann.client.participant_id)
        assert event.receiver_participant == bob.client.participant_id
