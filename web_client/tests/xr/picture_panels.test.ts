// Pictures of real cameras in a headset: where they stand, how they are chosen, what is shown and said of them.

import { type MeshBasicMaterial, type Mesh, Texture } from "three";
import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";

import { type FromWorker, nowMs } from "../../src/core/api.ts";
import type { WorkerClient } from "../../src/core/page_client.ts";
import { PageState } from "../../src/ui/state.ts";
import { MAX_PANELS, type Mode, type Stream, StreamChoices } from "../../src/ui/stream_choices.ts";
import { PicturePanels } from "../../src/xr/picture_panels.ts";
import { findRow, fitPicture, followHead, placePanel, placeRow, type Stand } from "../../src/xr/picture_places.ts";
import type { FrameReading, Vec3 } from "../../src/xr/reading.ts";

/** Looks to the left, as `yaw` says, and up. */
const makeHead = (yaw: number, pitch = 0, p: Vec3 = [1, 2, 1.6]): NonNullable<FrameReading["head"]> => {
  const [c, s, cp, sp] = [Math.cos(yaw / 2), Math.sin(yaw / 2), Math.cos(pitch / 2), Math.sin(-pitch / 2)];
  return [[...p], [c * cp, -s * sp, c * sp, s * cp]];
};
const toward = (from: Vec3, to: Vec3) => {
  const offset = to.map((value, i) => value - from[i]!);
  const length = Math.hypot(...offset);
  return { origin: from, direction: offset.map((value) => value / length) as unknown as Vec3 };
};
const STAND = followHead(makeHead(2), null) as Stand;

describe("places", () => {
  test("all keep free what is before the person, and panels do not overlap", () => {
    const half = Math.atan(fitPicture(4 / 3)[0] / 2);
    const seen = [0, 1, 2, 3].map((slot) => {
      const [[x, y, z]] = placePanel(STAND, slot);
      return { angle: Math.atan2(y - STAND.eyes[1], x - STAND.eyes[0]) - STAND.heading, up: z - STAND.eyes[2] };
    });
    for (const { angle } of seen) expect(Math.abs(angle) - half).toBeGreaterThan(0.35); // 20 degrees
    seen.forEach((a, i) => {
      for (const b of seen.slice(i + 1)) expect(Math.abs(a.angle - b.angle) > 2 * half || Math.abs(a.up - b.up) > fitPicture(4 / 3)[1]).toBe(true);
    });
    expect(findRow(toward(STAND.eyes, [STAND.eyes[0] + Math.cos(2), STAND.eyes[1] + Math.sin(2), 1.7]), STAND, 17)).toBeNull();
  });

  test("a picture has its own aspect, and fits", () => {
    for (const aspect of [4 / 3, 16 / 9, 3 / 4, 100]) expect(fitPicture(aspect)[0] / fitPicture(aspect)[1]).toBeCloseTo(aspect);
    expect(Math.max(...fitPicture(0.01), ...fitPicture(100))).toBeLessThan(0.5);
  });

  test("they stay while the person looks at any of them, and follow who turns or goes away", () => {
    const follows = (head: NonNullable<FrameReading["head"]>): boolean => followHead(head, STAND) !== STAND;
    expect([2 + 0.63, 2 - 1.08, 2 - 2 * Math.PI].map((yaw) => follows(makeHead(yaw)))).toEqual([false, false, false]);
    expect([2 + 1.6, 2 + Math.PI].map((yaw) => follows(makeHead(yaw)))).toEqual([true, true]);
    expect([follows(makeHead(2, 0, [1.5, 2, 1.6])), follows(makeHead(2, 0, [2, 2, 1.6]))]).toEqual([false, true]);
    const down = makeHead(-1, -1.5); // straight ahead is not known
    expect([follows(down), followHead(down, null)]).toEqual([false, null]);
  });

  test("a ray finds the row that it points at, from where the hand is, and none beside, behind or below the list", () => {
    const right = [Math.sin(STAND.heading + 0.63), -Math.cos(STAND.heading + 0.63)] as const;
    const at = (row: number, beside = 0.1): Vec3 => {
      const [x, y, z] = placeRow(STAND, row);
      return [x + beside * right[0], y + beside * right[1], z];
    };
    const hand: Vec3 = [STAND.eyes[0] + 0.1, STAND.eyes[1] - 0.2, 1.1];
    for (const row of [0, 1, 4]) {
      const ray = toward(hand, at(row));
      const found = findRow(ray, STAND, 5)!;
      expect(found.row).toBe(row);
      expect(found.distance).toBeCloseTo(Math.hypot(...at(row).map((value, i) => value - hand[i]!)));
      expect(findRow({ ...ray, direction: ray.direction.map((value) => -value) as unknown as Vec3 }, STAND, 5)).toBeNull();
    }
    for (const point of [at(5), at(-1), at(2, -0.05), at(2, 0.45)]) expect(findRow(toward(hand, point), STAND, 5)).toBeNull();
  });
});

describe("panels", () => {
  const makeStream = (stream: string, more: Partial<Stream> = {}): Stream => ({
    stream, encoding: "jpeg", audience: "remote", budget_class: "full", mbit_per_s: 0, title: `The ${stream}`, camera: null, fault: "", detail: "", stale: false, taken_by: "", hz: 0, ...more,
  });
  let listeners: [string, (update: FromWorker) => void][];
  let state: PageState;
  let choices: StreamChoices;
  let panels: PicturePanels;
  let streams: Stream[];

  beforeEach(() => {
    vi.stubGlobal("document", { createElement: () => ({ getContext: () => null }) });
    vi.stubGlobal("requestAnimationFrame", () => 0);
    listeners = [];
    const client = {
      on: (type: string, listener: (update: FromWorker) => void) => {
        listeners.push([type, listener]);
        return () => (listeners = listeners.filter(([, other]) => other !== listener));
      },
    } as unknown as WorkerClient;
    state = new PageState(client);
    choices = new StreamChoices(() => [], () => true);
    panels = new PicturePanels(state, choices, client);
    streams = [makeStream("front"), makeStream("wrist")];
    say();
  });

  afterEach(() => void vi.restoreAllMocks());

  const emit = (update: { type: string; [field: string]: unknown }): void => {
    for (const [type, listener] of listeners) if (type === update.type) listener(update as unknown as FromWorker);
  };
  /** Let the session describe its streams, and half a second pass. */
  const say = (mode: Mode = "immersive-vr"): void => {
    state.mode = mode;
    emit({ type: "budget", budget: { streams } });
    vi.spyOn(performance, "now").mockReturnValue(performance.now() + 600);
    panels.update();
  };
  const show = (stream: string, width = 64, height = 48): { isClosed: boolean } => {
    const bitmap = { width, height, isClosed: false, close: () => void Object.assign(bitmap, { width: 0, height: 0, isClosed: true }) };
    emit({ type: "picture", stream, bitmap, capture_ms: nowMs() - 250, received_ms: nowMs() });
    return bitmap;
  };
  type Internal = { panels: Map<string, { label: { shown: string }; plane: Mesh; material: MeshBasicMaterial; texture: Texture }>; rows: { shown: string }[] };
  const inside = (): Internal => panels as unknown as Internal;
  const panel = (stream: string) => inside().panels.get(stream)!;
  const wanted = (): string[] => choices.listWanted(streams, state.mode);
  const look = (direction: Vec3) =>
    panels.move({ head: makeHead(2), inputs: [{ side: "right", tracked: true, ray: { origin: STAND.eyes, direction } }] } as unknown as FrameReading);
  const pointAt = (row: number): Vec3 => {
    const [x, y, z] = placeRow(STAND, row);
    return toward(STAND.eyes, [x + 0.1 * Math.sin(2.63), y - 0.1 * Math.cos(2.63), z]).direction;
  };

  test("without pictures in the session there is no menu, and nothing to do in a frame", () => {
    streams = [makeStream("room", { encoding: "cloud" })];
    say();
    expect(panels.items).toEqual([]);
    expect(look(pointAt(0))).toBe(look(pointAt(0)));
    expect([panels.stand, panels.group.children.filter(({ visible }) => visible)]).toEqual([null, []]);
  });

  test("a menu is opened and closed, and items of it open and close panels, which alone are subscribed to", () => {
    expect([panels.items, wanted()]).toEqual([["menu"], []]);
    expect(look(pointAt(1))).toEqual([]);
    expect(look(pointAt(0))).toMatchObject([{ side: "right", target: "menu" }]);
    panels.press("menu");
    expect(panels.items).toEqual(["menu", "picture front", "picture wrist"]);
    expect(look(pointAt(2))).toMatchObject([{ target: "picture wrist" }]);
    panels.press("picture wrist");
    expect(wanted()).toEqual(["wrist"]);
    panels.update();
    expect(inside().rows.map(({ shown }) => shown)).toEqual(["Close this list", "▯ The front", "▶ Close: The wrist"].map((text) => expect.stringContaining(`"${text}"`)));
    panels.press("picture wrist");
    panels.press("picture gone");
    expect([wanted(), inside().panels.size, panels.items.length]).toEqual([[], 0, 3]);
    panels.press("menu");
    expect(panels.items).toEqual(["menu"]);
  });

  test.each(["immersive-ar", "immersive-vr"] as const)("one panel too many closes the oldest one, and the others stay in their places: %s", (mode) => {
    streams = Array.from({ length: MAX_PANELS + 1 }, (_, i) => makeStream(`c${i}`));
    say(mode);
    look([1, 0, 0]);
    for (const { stream } of [...streams.slice(1), streams[0]!].slice(0, MAX_PANELS)) panels.press(`picture ${stream}`);
    const before = panels.group.children.filter(({ type }) => type === "Group").map(({ position }) => position.toArray());
    panels.press("picture c0");
    expect([...inside().panels.keys()]).toEqual(["c2", "c3", "c4", "c0"]);
    expect(wanted()).toEqual(["c0", "c2", "c3", "c4"]);
    const after = panels.group.children.filter(({ type }) => type === "Group").map(({ position }) => position.toArray());
    expect(after).toEqual([...before.slice(1), before[0]]);
  });

  test("a picture goes into the same texture as the one before, which is closed; one of another size into a new one", () => {
    panels.press("picture front");
    const { texture, plane, material } = panel("front");
    const disposed = vi.fn();
    texture.addEventListener("dispose", disposed);
    expect(material.map).toBeNull();
    const first = show("front");
    expect([material.map, texture.image, first.isClosed]).toEqual([texture, first, false]);
    disposed.mockClear();
    const { version } = texture;
    const second = show("front");
    expect([texture.image, texture.version > version, first.isClosed, second.isClosed]).toEqual([second, true, true, false]);
    expect(disposed).not.toHaveBeenCalled();
    const wide = show("front", 160, 90);
    expect([second.isClosed, wide.isClosed, disposed.mock.calls.length]).toEqual([true, false, 1]);
    expect(plane.scale.x / plane.scale.y).toBeCloseTo(16 / 9);
    panels.press("picture front");
    expect(wide.isClosed).toBe(true);
    expect(show("front").isClosed).toBe(true); // it was on its way
  });

  test("one that comes before its panel is not lost: there may be no other", () => {
    choices.choose(streams[0]!, true, "immersive-vr"); // in a window beside the headset
    expect(show("front").isClosed).toBe(false);
    panels.dispose();
    expect([inside().panels.get("front")!.label.shown, show("front").isClosed]).toEqual([expect.stringContaining("The front"), false]); // the page's again
  });

  test("a panel says what it shows, how old it is, and that it is stale or faulty", () => {
    const words = (stream: string): string => JSON.parse(panel(stream).label.shown)[0].join("|");
    panels.press("picture front");
    expect(words("front")).toBe("The front|waiting for its next picture");
    emit({ type: "clock", session_offset_ms: 0, rtt_ms: 1, error_ms: 0, settled: true });
    show("front");
    const { color } = panel("front").material;
    say();
    expect(words("front")).toMatch(/^The front\|\d+ ms old$/);
    expect(color.getHex()).toBe(0xffffff);
    streams = [makeStream("front", { stale: true })];
    say();
    expect(words("front")).toMatch(/^The front\|.* old\|stale$/);
    expect(color.r).toBeLessThan(0.5);
    streams = [makeStream("front", { title: "", fault: "moved", detail: "by <b>3 cm</b>" })];
    say();
    expect(words("front")).toMatch(/^front\|.* old\|its camera was moved: calibrate it again: by\|<b>3 cm<\/b>$/);
    streams = [];
    say();
    expect([inside().panels.size, panels.items]).toEqual([0, []]);
  });
});
