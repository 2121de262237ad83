// Panels with the pictures of the scene's cameras, as a recording of them would show the scene: chosen in a menu,
// remembered by name, with a warning when the gripper of a held robot leaves a picture. Those of real cameras are beside them.

import { aspectOf, listWatched } from "../view/framing.ts";
import type { View } from "../view/view.ts";
import { closeOutside, h, KeyedList, type Row, setText } from "./dom.ts";
import type { Pictures } from "./pictures.ts";
import type { PageState } from "./state.ts";
import { recall, remember } from "./storage.ts";

const STORAGE_KEY = "iris-session.cameras";
const MAX_SHOWN = 4;
const CHECK_MS = 200;
/** Shares of half the picture at its edge: nearer than the first is a warning, farther than the second ends it. */
const MARGINS = [0.05, 0.1] as const;

interface SceneCamera {
  name: string;
  index: number;
  aspect: number;
}

export interface Cameras {
  /** The panels, over the picture. */
  element: HTMLElement;
  /** The choice of cameras, for the bar over the picture. */
  menu: HTMLElement;
  update(): void;
}

/** Make panels and menu. `view` null: no pictures of the scene. `pictures`: of real cameras. */
export function makeCameras(state: PageState, view: View | null, pictures: Pictures): Cameras {
  const remembered = recall<{ shown: string[] }>(STORAGE_KEY, { shown: [] });
  const scenePanels = h("div", { class: "same" });
  const element = h("div", { class: "pictures" }, pictures.element, scenePanels);
  const choices = h("ul");
  const ofScene = h("section", {}, h("p", { class: "heading" }, "As the scene's cameras record it"), choices);
  const ofStreams = h("section", {}, h("p", { class: "heading" }, "Real cameras"), pictures.choices);
  const summary = h("summary", { class: "small" }, "Cameras");
  const menu = h("details", { class: "menu", hidden: true }, summary, h("div", { class: "popover" }, ofStreams, ofScene));
  closeOutside(menu, summary);
  const places = new Map<string, HTMLElement>();
  const warnings = new Map<string, { text: HTMLElement; panel: HTMLElement; outside: Set<string> }>();
  let listed: unknown = null;

  const rows = new KeyedList<SceneCamera>(choices, ({ name }) => {
    const box = h("input", { type: "checkbox" });
    box.addEventListener("change", () => {
      const others = remembered.shown.filter((one) => one !== name);
      remembered.shown = box.checked ? [...others.slice(-(MAX_SHOWN - 1)), name] : others;
      remember(STORAGE_KEY, remembered);
      listed = null;
      state.touch();
    });
    const update = (): void => {
      box.checked = remembered.shown.includes(name);
    };
    return { element: h("li", {}, h("label", { class: "check" }, box, h("span", {}, name))), update };
  });
  const panels = new KeyedList<SceneCamera>(scenePanels, (camera) => makePicture(camera));

  function makePicture({ name }: SceneCamera): Row<SceneCamera> {
    const place = h("div", { class: "place", role: "img", aria: { label: `Picture of the camera ${name}` } });
    const text = h("p", { class: "outside", role: "status" });
    const panel = h("figure", { class: "picture", data: { camera: name } }, h("figcaption", {}, name), place, text);
    places.set(name, place);
    warnings.set(name, { text, panel, outside: new Set() });
    return { element: panel, update: ({ aspect }) => (place.style.aspectRatio = String(aspect)) };
  }

  function listShown(): SceneCamera[] {
    const cameras = listCameras(state);
    return cameras.filter(({ name }) => remembered.shown.includes(name)).slice(0, MAX_SHOWN);
  }

  function check(): void {
    if (!view) return;
    const mine = state.heldBy(state.selfId);
    const isWatched = (robot: string): boolean => (mine.length > 0 ? mine.includes(robot) : (state.lease(robot)?.holder ?? "") !== "");
    const robots = state.session?.robots ?? [];
    const parents = new Map(state.spec?.bodies.map((body) => [body.id, body.parent]));
    for (const { name, index } of listShown()) {
      const warning = warnings.get(name);
      const camera = state.spec?.cameras[index];
      if (!warning || !camera) continue;
      const watched = listWatched(camera.body, robots, parents).filter((robot) => isWatched(robot.name));
      const { outside } = warning;
      const left = watched.filter((robot) => {
        const margin = outside.has(robot.name) ? MARGINS[1] : MARGINS[0];
        return !view.pictures.isInside(view.scene, index, robot.site_body, robot.T_body_site, margin);
      });
      warning.outside = new Set(left.map((robot) => robot.name));
      const names = [...warning.outside].join(", ");
      setText(warning.text, names ? `Outside this picture: the gripper of ${names}` : "");
      warning.panel.classList.toggle("bad", names !== "");
    }
  }
  setInterval(check, CHECK_MS);

  return {
    element,
    menu,
    update: () => {
      const cameras = listCameras(state);
      ofScene.hidden = view === null || cameras.length === 0;
      ofStreams.hidden = !pictures.isOffered;
      menu.hidden = ofScene.hidden && ofStreams.hidden;
      pictures.update();
      rows.update(cameras, ({ name }) => name);
      const shown = listShown();
      panels.update(shown, ({ name }) => name);
      if (listed === state.spec) return;
      listed = state.spec;
      view?.pictures.setPanels(shown.map(({ name, index }) => ({ index, element: places.get(name)! })));
      view?.touch();
    },
  };
}

/** Return the cameras of the scene; those without a name, or with that of another, have a number. */
function listCameras(state: PageState): SceneCamera[] {
  const cameras = state.spec?.cameras ?? [];
  return cameras.map((camera, index) => {
    const isUnique = camera.name !== "" && cameras.findIndex((one) => one.name === camera.name) === index;
    return { name: isUnique ? camera.name : `${camera.name || "camera"} ${index}`, index, aspect: aspectOf(camera) };
  });
}
