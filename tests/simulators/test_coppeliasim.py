"""The adapter for CoppeliaSim over a conversation made by hand: no CoppeliaSim takes part."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session import AssetStore, SceneBuilder
from iris_session.protocol.common import Pose
from iris_session.protocol.names import GeometryKind
from iris_session.simulators import SimulatorError, TipTarget, find_adapter
from tools.coppelia_conversation import Conversation

MODULE = "coppeliasim_zmqremoteapi_client"


class Client:
    """As `RemoteAPIClient` of the package, without its socket."""

    def __init__(self, conversation: Conversation) -> None:
        self.conversation = conversation

    def call(self, func: str, args: Any) -> Any:
        reply = self.conversation.answer({"func": func, "args": list(args), "argsL": len(args), "uuid": "0"})
        if "err" in reply:
            raise Exception(reply["err"])  # noqa: TRY002 - as the package does
        ret = reply["ret"]
        return ret[0] if len(ret) == 1 else tuple(ret) or None

    def require(self, name: str) -> Any:
        self.call("zmqRemoteApi.require", [name])
        info = self.call("zmqRemoteApi.info", [name])
        found = type(name, (), {"__module__": MODULE})
        for key, value in info.items():
            function = (lambda *a, func=f"{name}.{key}": self.call(func, a)) if "func" in value else value["const"]
            setattr(found, key, function)
        return found


Client.__module__ = MODULE


@pytest.fixture
def conversation() -> Conversation:
    return Conversation()


@pytest.mark.parametrize("gives_sim", [False, True])
def test_scene_and_poses_are_those_of_the_conversation(
    conversation: Conversation, gives_sim: bool, tmp_path: Any
) -> None:
    client = Client(conversation)
    sim = client.require("sim")
    adapter = find_adapter(sim if gives_sim else client)
    assert adapter is not None
    builder = SceneBuilder(adapter.name)
    adapter.build(builder)
    assert adapter.bodies == ["Crate", "link", "Arm/tip"], "floor and base stand still, the respondable is hidden"
    made = builder.build(AssetStore(tmp_path))
    crate = next(body.id for body in made.spec.bodies if body.name == "Crate")
    parts = [visual for visual in made.spec.visuals if visual.body == crate]
    assert [visual.geometry.kind for visual in parts] == [GeometryKind.MESH, GeometryKind.MESH]
    assert [visual.rgba[:3] for visual in parts] == [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    assert len(made.spec.meshes) == 1, "equal parts are sent once"
    steps: list[str] = []
    end = adapter.wrap_step(lambda: steps.append("before"), lambda: steps.append("after"))
    assert end is not None
    sim.step()
    assert steps == ["before", "after"]
    state = adapter.read_state()
    x, y, z, qx, qy, qz, qw = conversation.objects[11].pose
    assert state.time_s == 0.05
    assert state.positions[0].tolist() == [x, y, z]
    assert state.quaternions[0].tolist() == [qw, qx, qy, qz]
    end()
    sim.step()
    assert steps == ["before", "after"]


def test_shapes_that_stand_still_are_asked_for_once(conversation: Conversation) -> None:
    adapter = find_adapter(Client(conversation))
    assert adapter is not None
    adapter.build(SceneBuilder("coppelia"))
    conversation.requests.clear()
    adapter.read_state()
    assert conversation.requests.count("sim.getObjectPose") == len(adapter.bodies) == 3


def test_participants_move_the_target_of_a_model(conversation: Conversation) -> None:
    adapter = find_adapter(Client(conversation))
    assert adapter is not None
    adapter.build(SceneBuilder("coppelia"))
    assert [(robot.name, robot.tip_body) for robot in adapter.robots] == [("Arm", "Arm/tip")]
    adapter.apply_targets({"Arm": TipTarget(Pose((0.1, 0.2, 0.3), (0.5, 0.5, 0.5, 0.5)), 1.0)})
    assert conversation.objects[16].pose == [0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5]


def test_another_object_of_the_package_is_refused() -> None:
    thing = type("Other", (), {"__module__": MODULE})()
    with pytest.raises(SimulatorError, match="RemoteAPIClient"):
        find_adapter(thing)
