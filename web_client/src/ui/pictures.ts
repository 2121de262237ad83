// Panels with the pictures of real cameras, that is of streams of encoding `jpeg`: chosen in a menu, subscribed to while
// they are open. Those of a headset are in `xr/picture_panels.ts`.

import type { PictureUpdate } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { MediaEncoding } from "../protocol/messages.g.ts";
import { aspectOf } from "../view/framing.ts";
import { h, KeyedList, type Row, setText } from "./dom.ts";
import type { PageState } from "./state.ts";
import type { Stream, StreamChoices } from "./stream_choices.ts";
import { describeState } from "./streams.ts";
import { budgetWords, streamAgeWords } from "./words.ts";

export interface Pictures {
  /** The open panels. */
  element: HTMLElement;
  /** A list to choose from, for the menu of cameras. */
  choices: HTMLElement;
  /** Whether the session has any. */
  readonly isOffered: boolean;
  update(): void;
}

export function makePictures(state: PageState, client: WorkerClient, choices: StreamChoices): Pictures {
  const element = h("div", { class: "same" });
  const list = h("ul");
  const shown = new Map<string, (picture: PictureUpdate) => void>();
  const rows = new KeyedList<Stream>(list, (first) => {
    let one = first;
    const box = h("input", { type: "checkbox" });
    box.addEventListener("change", () => {
      choices.choose(one, box.checked, state.mode);
      state.touch();
    });
    const title = h("span");
    const update = (item: Stream): void => {
      one = item;
      box.checked = choices.isShown(one, state.mode);
      setText(title, one.title || one.stream);
    };
    return { element: h("li", {}, h("label", { class: "check" }, box, title)), update };
  });
  const panels = new KeyedList<Stream>(element, ({ stream }) => {
    const { show, ...row } = makePanel(stream, state);
    shown.set(stream, show);
    return row;
  });
  client.on("picture", (picture) => {
    if (state.mode !== "screen") return; // it is the headset's
    const show = shown.get(picture.stream);
    if (show) show(picture);
    else picture.bitmap.close(); // its panel was closed while it was on its way
  });
  return {
    element,
    choices: list,
    get isOffered() {
      return listPictures(state).length > 0;
    },
    update: () => {
      rows.update(listPictures(state), ({ stream }) => stream);
      const open = state.mode === "screen" ? choices.listPanels(listPictures(state), "screen") : [];
      for (const stream of shown.keys()) if (!open.some((one) => one.stream === stream)) shown.delete(stream);
      panels.update(open, ({ stream }) => stream);
    },
  };
}

/** Return the streams of the session that are pictures. */
export function listPictures(state: PageState): Stream[] {
  return (state.budget?.streams ?? []).filter(({ encoding }) => encoding === MediaEncoding.JPEG);
}

/** Return the width of a picture by its height before one has come: as its camera is described. */
export const expectAspect = ({ camera }: Stream): number => aspectOf({ resolution: camera ? [camera.width, camera.height] : [4, 3] });

/** Return what is said of a picture: how old it is, and why it is not as things are now, or why there is none. */
export function describePicture(one: Stream, state: PageState, hasPicture: boolean): { age: string; text: string; isBad: boolean } {
  const why = describeState(one, state);
  const words = [why, one.detail].filter((part) => part !== "").join(": ");
  return {
    age: hasPicture ? streamAgeWords(state.ageOf(one.stream) ?? Number.NaN) : "",
    text: words || (hasPicture ? "" : budgetWords(one.budget_class) || "waiting for its next picture"),
    isBad: why !== "",
  };
}

function makePanel(stream: string, state: PageState): Row<Stream> & { show(picture: PictureUpdate): void } {
  const title = h("span", { class: "title" });
  const age = h("span", { class: "age" });
  const canvas = h("canvas", { class: "place", role: "img" });
  const context = canvas.getContext("bitmaprenderer");
  const text = h("p", { class: "outside", role: "status" });
  const element = h("figure", { class: "picture live", data: { stream } }, h("figcaption", {}, title, age), canvas, text);
  let hasPicture = false;
  return {
    element,
    show: ({ bitmap }) => {
      hasPicture = true;
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
      context?.transferFromImageBitmap(bitmap);
    },
    update: (one) => {
      const name = one.title || stream;
      setText(title, name);
      canvas.setAttribute("aria-label", `Picture of the camera ${name}`);
      canvas.style.aspectRatio = hasPicture ? "" : String(expectAspect(one));
      const words = describePicture(one, state, hasPicture);
      setText(age, words.age);
      setText(text, words.text);
      element.classList.toggle("bad", words.isBad);
    },
  };
}
