"""The page in a real Chromium, against a real session and its gateway."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from iris_session.bench.web_tab import WEB_CLIENT
from iris_session.demo.named_scenes import scene_by_name
from iris_session.protocol.server_messages import Event, Gap, ParticipantChanged, ParticipantJoined
from tests.e2e.browser import Browser, Page, decode_picture, join_as, printed_address
from tests.e2e.emulated_quest import HEADSET
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import COMMAND, DEADLINE_S, END_WITH_PARENT, SessionProcess
from tests.scene.pictures import ModelRenderer, graphics, silhouette_iou

pytestmark = pytest.mark.e2e

WIDTH, HEIGHT = 640, 360
#: Silhouettes, and mean difference of colours where both draw something [of 255]: without a graphics card large meshes
#: are drawn in a coarser level; exact ones differ by 0.5.
MIN_IOU, MAX_COLOUR_DIFFERENCE = 0.97, 8.0


# --- the picture ------------------------------------------------------------------------------------------------------


class Reference:
    """MuJoCo's own picture of a model, at the poses that the page drew."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._renderer = ModelRenderer(model, WIDTH, HEIGHT)
        self.model, self.data = model, self._renderer.data
        self.camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, self.camera)

    def look_from(self, azimuth: float, elevation: float, distances: float) -> dict[str, Any]:
        """Place the camera. `distances`: in extents of the scene. Return it as the page takes it."""
        self.camera.azimuth, self.camera.elevation = azimuth, elevation
        self.camera.distance = distances * self.model.stat.extent
        return {
            "lookat": [float(x) for x in self.camera.lookat],
            "azimuth": azimuth,
            "elevation": elevation,
            "distance": float(self.camera.distance),
            "fovy": float(self.model.vis.global_.fovy),
        }

    def place(self, drawn: dict[str, Any]) -> None:
        """Move bodies and deformables to where the page drew them."""
        for body, pose in zip(drawn["bodies"], np.array(drawn["poses"]).reshape(-1, 7), strict=True):
            self.data.xpos[body], self.data.xquat[body] = pose[:3], pose[3:] / np.linalg.norm(pose[3:])
            mujoco.mju_quat2Mat(self.data.xmat[body], self.data.xquat[body])
        for geom in range(self.model.ngeom):
            body = self.model.geom_bodyid[geom]
            rotation, turn = self.data.xmat[body].reshape(3, 3), np.empty(9)
            mujoco.mju_quat2Mat(turn, self.model.geom_quat[geom])
            self.data.geom_xpos[geom] = self.data.xpos[body] + rotation @ self.model.geom_pos[geom]
            self.data.geom_xmat[geom] = (rotation @ turn.reshape(3, 3)).ravel()
        for k, vertices in enumerate(drawn["vertices"].values()):
            begin = self.model.flex_vertadr[k]
            count = self.model.flex_vertnum[k]
            self.data.flexvert_xpos[begin : begin + count] = np.array(vertices).reshape(-1, 3)

    def draw(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the picture without shadows and reflections, and where something other than a plane is."""
        picture = self._renderer.colour(self.camera)
        number = self._renderer.segments(self.camera)
        is_geom = self._renderer.segments(self.camera, "objtype") == int(mujoco.mjtObj.mjOBJ_GEOM)
        kinds = self.model.geom_type[np.where(is_geom, number, 0)]
        is_plane = is_geom & (kinds == int(mujoco.mjtGeom.mjGEOM_PLANE))
        return picture, (number >= 0) & ~is_plane


@pytest.mark.long
@pytest.mark.parametrize(
    ("scene", "distances"), [("handover", 1.35), ("cloth", 1.35), pytest.param("aloha", 0.9, marks=pytest.mark.long)]
)
def test_the_page_draws_what_mujoco_draws(
    serve: Callable[..., SessionProcess], open_page: Callable[..., Page], scene: str, distances: float
) -> None:
    page = open_page(serve(scene), "viewer")
    with graphics():
        reference = Reference(scene_by_name(scene).model)
        arrived = "[...irisSession.view.shown.vertices.values()].filter((one) => one.length > 0).length"
        page.wait(f"{arrived} === {reference.model.nflex}")
        for azimuth, elevation in ((145.0, -28.0), (30.0, -20.0), (260.0, -50.0)):
            camera = reference.look_from(azimuth, elevation, distances)
            page.evaluate(f"irisSession.view.viewpoint.setFree({json.dumps(camera)})")
            drawn = page.read_picture(WIDTH, HEIGHT, silhouette=True)
            reference.place(drawn)
            picture, mask = reference.draw()
            silhouette = drawn["image"][..., 0] > 127
            assert mask.mean() > 0.02
            assert silhouette_iou(mask, silhouette) >= MIN_IOU
            colours = page.read_picture(WIDTH, HEIGHT, silhouette=False)["image"]
            difference = np.abs(colours.astype(int) - picture)[mask & silhouette]
            assert difference.mean() <= MAX_COLOUR_DIFFERENCE
    assert page.errors == []


#: Draws the frame of the page once more, without labels and people. Returns the size and the picture.
SHADED: Final = """(() => {
  const { view } = irisSession;
  view.overlay.visible = false;
  view.renderer.shadowMap.needsUpdate = true;
  view.renderer.render(view.root, view.viewpoint.camera);
  view.overlay.visible = true;
  return [view.canvas.width, view.canvas.height, view.canvas.toDataURL("image/png")];
})()"""


def write_parts(path: Path, spheres: int, boxes: int) -> None:
    """Write a model with bodies of one shape each in a grid, of different sizes and colours; every 100th floats."""
    rng = np.random.default_rng(1)
    side = math.ceil((spheres + boxes) ** (1 / 3))
    bodies = []
    for i in range(spheres + boxes):
        p = 0.12 * np.array([i % side, i // side % side, i // side**2])
        kind, size = ("sphere", rng.uniform(0.02, 0.05, 1)) if i < spheres else ("box", rng.uniform(0.02, 0.05, 3))
        place, rgb, half = (" ".join(f"{v:.3f}" for v in values) for values in (p, rng.random(3), size))
        joint = "<freejoint/>" if i % 100 == 0 else ""
        geom = f'<geom type="{kind}" size="{half}" rgba="{rgb} 1" contype="0" conaffinity="0"/>'
        bodies.append(f'<body pos="{place}" euler="{10 * (i % 9)} 0 {i % 90}">{joint}{geom}</body>')
    path.write_text(
        '<mujoco><option gravity="0 0 0"/><worldbody><light pos="0 0 5"/>' + "".join(bodies) + "</worldbody></mujoco>"
    )


def test_many_equal_shapes_are_few_draws_and_look_as_mujoco_draws_them(
    serve: Callable[..., SessionProcess], open_page: Callable[..., Page], tmp_path: Path
) -> None:
    path = tmp_path / "parts.xml"
    write_parts(path, spheres=400, boxes=1000)
    page = open_page(serve(str(path)), "parts")
    page.evaluate(SHADED)
    assert page.evaluate("irisSession.view.renderer.info.render.calls") <= 60
    with graphics():
        reference = Reference(mujoco.MjModel.from_xml_path(str(path)))
        camera = reference.look_from(145.0, -28.0, 1.5)
        page.evaluate(f"irisSession.view.viewpoint.setFree({json.dumps(camera)})")
        drawn = page.read_picture(WIDTH, HEIGHT, silhouette=True)
        reference.place(drawn)
        picture, mask = reference.draw()
    silhouette = drawn["image"][..., 0] > 127
    assert silhouette_iou(mask, silhouette) >= MIN_IOU
    colours = page.read_picture(WIDTH, HEIGHT, silhouette=False)["image"]
    assert np.abs(colours.astype(int) - picture)[mask & silhouette].mean() <= MAX_COLOUR_DIFFERENCE
    assert page.errors == []


def test_a_file_in_millimetres_is_seen_whole_and_lit_and_its_unit_is_doubted(
    serve: Callable[..., SessionProcess], browser: Browser, tmp_path: Path
) -> None:
    trimesh.creation.box((300, 200, 250)).export(tmp_path / "part.glb")
    page = browser.open("millimetres", printed_address(serve(str(tmp_path / "part.glb"))))
    page.wait("irisSession.view.scene && irisSession.state.session?.synced")
    page.evaluate("irisSession.view.scene.complete.then(() => null)")
    mask = page.read_picture(WIDTH, HEIGHT, silhouette=True)["image"][..., 0] > 127
    assert mask.mean() > 0.1
    assert not np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any()
    colours = page.read_picture(WIDTH, HEIGHT, silhouette=False)["image"][mask]
    assert colours.max() > 180
    assert np.percentile(colours, 5) > 80
    page.wait("/--scale 0.001/.test(document.querySelector('#panel-advice').textContent)")
    page.close()


def test_objects_cast_shadows_without_a_graphics_card(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "shadows")
    width, height, url = page.evaluate(SHADED)
    plain = page.read_picture(width, height, silhouette=False)["image"].astype(int)
    darker = (plain - decode_picture(url)).max(axis=2)
    assert 0.005 < (darker > 15).mean() < 0.3
    assert (darker < -15).mean() < 0.001


# --- people and leases ------------------------------------------------------------------------------------------------


def test_two_browsers_share_robots(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    """The second is seen as a participant, may wait for the robot, and takes over when that is allowed."""
    first = open_page(scenario.server, "first")
    join_as(first, "ann", "director")
    second = open_page(scenario.server, "second")
    join_as(second, "ben", "operator")
    first.wait("[...document.querySelectorAll('#panel-participants .name')].some((one) => one.textContent === 'ben')")
    first.click("button", "Take: left")
    second.wait("document.querySelector('[data-robot=left] .holder').textContent === 'ann'")
    offered = "[...document.querySelectorAll('[data-robot=left] .primary:not([hidden])')].map((one) => one.textContent)"
    assert second.evaluate(offered) == ["Wait for it"]
    first.select("Lease mode of left", "take over")
    second.click("button", "Take over: left")
    first.wait("document.querySelector('[data-robot=left] .holder').textContent === 'ben'")
    second.wait("document.querySelector('[data-robot=left] .holder').textContent === 'you'")
    first.select("Assign left to", "free")
    second.wait("document.querySelector('[data-robot=left] .holder').textContent === 'free'")
    assert first.errors == []
    assert second.errors == []


def test_stops_and_pauses_are_seen_on_every_screen(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "stopper")
    watcher = scenario.join("watcher", "director")
    watcher.control("pause")
    page.wait("/watcher/.test(document.querySelector('.banner.paused:not([hidden])')?.textContent)")
    assert page.evaluate("document.title").startswith("PAUSED")
    page.evaluate("document.querySelector('#resume').click()")
    scenario.run_until(lambda: not watcher.mirror.paused, "the session goes on")
    page.wait("document.querySelector('.banner.paused').hidden && document.title.startsWith('handover')")
    page.evaluate("document.activeElement.blur()")
    page.press("Space")
    scenario.run_until(lambda: watcher.mirror.estop, "the e-stop is in force")
    page.wait("!document.querySelector('.stopped').hidden && document.title.startsWith('STOPPED')")
    page.click("button", "Clear")
    scenario.run_until(lambda: not watcher.mirror.estop, "the e-stop is cleared")
    page.click("button", "E-STOP Space")
    scenario.run_until(lambda: watcher.mirror.estop, "the button stops, too")


def test_a_headset_can_be_tried_without_one(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    """The emulator is loaded when it is asked for. Mouse and keys are a person with a headset who is at her place."""
    page = open_page(scenario.server, "emulated", width=900, height=500)
    loaded = "performance.getEntriesByType('resource').some(({ name }) => name.includes('emulator'))"
    assert not page.evaluate(loaded)
    page.click("button", "Try an emulated headset")
    page.click("button", "Enter VR")
    assert page.evaluate(loaded)
    measured = f"{HEADSET}?.reading?.inputs.filter(({{ tracked, emulated }}) => tracked && !emulated).length === 2"
    page.wait(f"{measured} && irisSession.state.self?.devices.includes('head')")
    right = f"{HEADSET}.reading.inputs.find(({{ side }}) => side === 'right')"
    page.hold("ArrowUp")
    page.wait(f"{right}.ray.direction[2] > 0.3")
    page.let_go("ArrowUp")
    page.hold("ShiftLeft")
    page.evaluate("dispatchEvent(new PointerEvent('pointerdown'))")
    page.wait(f"{right}.squeeze === 1 && {right}.trigger === 1")
    page.let_go("ShiftLeft")
    page.evaluate("dispatchEvent(new PointerEvent('pointerup'))")
    page.wait(f"{right}.squeeze === 0 && {right}.trigger === 0")
    page.press("Escape")
    page.wait("irisSession.headset.headset === null")
    page.click("button", "Whole scene")  # nothing lies over the bar
    assert page.errors == []


# --- everyone ---------------------------------------------------------------------------------------------------------


def focus_by_tab(page: Page, name: str) -> None:
    """Press Tab until the control with this name has the focus."""
    for _ in range(80):
        page.press("Tab")
        if page.evaluate("(document.activeElement.ariaLabel ?? document.activeElement.textContent).trim()") == name:
            return
    raise AssertionError(f"{name} is not reached by Tab")


@pytest.mark.long
def test_the_keyboard_alone_is_enough(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    page = open_page(scenario.server, "keys")
    focus_by_tab(page, "Take: left")
    page.press("Enter")
    page.wait("document.querySelector('[data-robot=left] .holder').textContent === 'you'")
    focus_by_tab(page, "Release: left")
    page.press("Enter")
    page.wait("document.querySelector('[data-robot=left] .holder').textContent === 'free'")
    page.press("Shift+Space")  # whatever has the focus
    page.wait("irisSession.state.session.estop")
    focus_by_tab(page, "Clear")
    page.press("Enter")
    page.wait("!irisSession.state.session.estop")
    page.evaluate("document.querySelector('#scene').focus()")
    before = page.evaluate("irisSession.view.viewpoint.camera.position.toArray()")
    page.press("ArrowLeft")
    assert page.evaluate("irisSession.view.viewpoint.camera.position.toArray()") != before


@pytest.mark.long
@pytest.mark.parametrize("phone", [False, True])
def test_axe_finds_nothing_serious(scenario: Scenario, open_page: Callable[..., Page], phone: bool) -> None:
    width, height = (390, 844) if phone else (1280, 800)
    page = open_page(scenario.server, "axe", width=width, height=height, phone=phone)
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.inject(WEB_CLIENT / "node_modules" / "axe-core" / "axe.min.js")
    violations = page.evaluate("axe.run().then((report) => report.violations)")
    assert [(one["id"], one["nodes"][0]["html"]) for one in violations] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width  # nothing is cut off


# --- pairing ----------------------------------------------------------------------------------------------------------


def make_link(role: str) -> tuple[subprocess.Popen[str], str]:
    """Start `iris-session pair --web` for the session of this home and return it with the link that it prints."""
    command = [*COMMAND, "pair", "--web", "--role", role]
    process = subprocess.Popen([*END_WITH_PARENT, *command], stdout=subprocess.PIPE, text=True)
    assert process.stdout
    for line in process.stdout:
        if match := re.search(r"in a browser (https://\S+#c=\S+)", line):
            return process, match.group(1)
    raise AssertionError("pair has printed no link")


@pytest.mark.long
def test_a_browser_pairs_by_the_printed_link(
    serve: Callable[..., SessionProcess], browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a code the form opens by itself; the link for observers lets in, and lets do nothing."""
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "keys"))
    server = serve("handover", "--curve")
    stranger = browser.open("stranger", printed_address(server))
    stranger.wait("document.querySelector('dialog').open")
    stranger.fill("Join code", "0000-0000-0000")
    stranger.fill("Name of this browser", "stranger")
    stranger.click("button", "Pair this browser")
    stranger.wait("document.querySelector('dialog .advice').textContent !== ''")
    stranger.close()
    pairing, link = make_link("observer")
    try:
        guest = browser.open("guest", link)
        guest.wait("document.querySelector('dialog').open")
        assert "c=" not in guest.evaluate("location.href")  # a code must not stay in the address
        guest.press("Enter")
        guest.wait_until_ready()
        assert guest.evaluate("irisSession.state.role") == "observer"
        assert guest.evaluate("[...document.querySelectorAll('[data-robot] button')].every((one) => one.hidden)")
        assert pairing.wait(DEADLINE_S) == 0
        offered = guest.evaluate("[...document.querySelector('#self-role').options].map((one) => one.value)")
        assert offered == ["observer"]
        chosen = json.dumps({"name": "Web", "role": "director", "roles": []})  # of a session that allowed it
        guest.evaluate(f"localStorage.setItem('iris-session.page', {json.dumps(chosen)})")
        guest.reload()
        guest.wait_until_ready()  # paired once, for good
        assert guest.evaluate("irisSession.state.role") == "observer"
        assert guest.errors == []
        guest.close()
    finally:
        pairing.kill()
        pairing.wait()
        if pairing.stdout:
            pairing.stdout.close()


# --- connections ------------------------------------------------------------------------------------------------------


def test_a_reload_resumes_with_the_lease(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    """The person is asked for name and role once, in place."""
    page = open_page(scenario.server, "reload")
    page.wait("!document.querySelector('.welcome').hidden && irisSession.state.role === 'director'")
    page.select("Your role", "operator: drives")
    page.fill("Name for others", "dan")
    page.click("button", "OK")
    page.wait("irisSession.state.role === 'operator' && document.querySelector('.welcome').hidden")
    page.click("button", "Take: left")
    page.wait("document.querySelector('[data-robot=left] .holder').textContent === 'you'")
    page.reload()
    page.wait_until_ready()
    assert page.evaluate("[irisSession.state.self.name, irisSession.state.role]") == ["dan", "operator"]
    assert page.evaluate("document.querySelector('.welcome').hidden")
    page.wait("document.querySelector('[data-robot=left] .holder').textContent === 'you'")


#: A tab in the background is tested for so long [s]: a minute with IRIS_BACKGROUND_S=60.
BACKGROUND_S: Final = float(os.environ.get("IRIS_BACKGROUND_S", "6"))


def is_of_the_machine(event: Event, watcher: str) -> bool:
    """Return whether an event says that a busy machine stood still, or that the watcher itself was lost and is back."""
    body = event.body
    joined = isinstance(body, ParticipantJoined | ParticipantChanged) and body.participant.name == watcher
    return isinstance(body, Gap) or joined


@pytest.mark.long
def test_a_tab_in_the_background_keeps_its_robot(scenario: Scenario, open_page: Callable[..., Page]) -> None:
    """Browsers run timers and frames of such a tab rarely or not at all. Its worker keeps the connection."""
    page = open_page(scenario.server, "background")
    join_as(page, "dan", "operator")
    page.click("button", "Take: left")
    page.wait("document.querySelector('[data-robot=left] .holder').textContent === 'you'")
    drawn = page.evaluate("irisSession.view.drawn")
    watcher = scenario.join("watcher")
    dan = page.evaluate("irisSession.state.self.id")
    scenario.run_until(lambda: watcher.mirror.leases["left"].holder == dan, "the watcher sees who has the robot")
    known = len(scenario.events["watcher"])
    with ThreadPoolExecutor(1) as thread:
        still = thread.submit(page.stand_still, BACKGROUND_S)
        scenario.run_for(0.8 * BACKGROUND_S)
        report = watcher.status()
        assert not still.done()
        heard_ns = next(one.heard_ns for one in report.participants if one.id == dan)
        assert 0 <= heard_ns < 0.4e9 * BACKGROUND_S, "the worker goes on sending"
        scenario.run_until(still.done, "the tab is in front again", BACKGROUND_S + DEADLINE_S)
        still.result()
    assert [one for one in scenario.events["watcher"][known:] if not is_of_the_machine(one, watcher.name)] == []
    assert watcher.mirror.leases["left"].holder == dan
    page.wait(f"irisSession.view.drawn > {drawn} && irisSession.state.phase.phase === 'ready'")
    assert page.evaluate("irisSession.state.self.id") == dan
    assert page.errors == []
