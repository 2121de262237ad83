// Which streams a page subscribes to, by kind, audience, mode and hand.

import { beforeEach, expect, test } from "vitest";

import { MAX_PANELS, type Stream, StreamChoices } from "../../src/ui/stream_choices.ts";

const makeStream = (stream: string, encoding: string, audience = "all"): Stream => ({
  stream, encoding, audience, budget_class: "full", mbit_per_s: 0, title: "", camera: null, fault: "", detail: "", stale: false, taken_by: "", hz: 0,
});
const ROOM = makeStream("room", "cloud", "remote");
const TABLE = makeStream("table", "cloud");
const CLOTH = makeStream("cloth", "deformable");
const FRONT = makeStream("front", "jpeg");
const BYTES = makeStream("bytes", "bytes");
const STREAMS = [ROOM, TABLE, CLOTH, FRONT, BYTES];

let choices: StreamChoices;

beforeEach(() => {
  choices = new StreamChoices(() => ["cloth"], () => true);
});

test("what the scene shows is wanted by itself, a picture only while its panel is open, and the rest never", () => {
  expect(choices.listWanted(STREAMS, "screen")).toEqual(["cloth", "room", "table"]);
  choices.choose(FRONT, true, "screen");
  choices.choose(BYTES, true, "screen");
  expect(choices.listWanted(STREAMS, "screen")).toEqual(["cloth", "front", "room", "table"]);
  choices.choose(FRONT, false, "screen");
  expect(choices.listWanted(STREAMS, "screen")).toEqual(["cloth", "room", "table"]);
});

test("in AR what is for remote people only is not wanted, and in VR it is", () => {
  expect(choices.listWanted(STREAMS, "immersive-ar")).toEqual(["cloth", "table"]);
  expect(choices.listWanted(STREAMS, "immersive-vr")).toEqual(["cloth", "room", "table"]);
  expect(choices.listWanted([makeStream("new", "cloud", "of another version")], "immersive-ar")).toEqual(["new"]);
});

test("panels that are open on the screen are in a headset, but in AR those for remote people only when they are chosen there", () => {
  const open = (one: Stream, mode: "screen" | "immersive-ar" | "immersive-vr"): boolean => choices.listWanted([one], mode).length > 0;
  const room = makeStream("room camera", "jpeg", "remote");
  for (const one of [FRONT, room]) choices.choose(one, true, "screen");
  expect([open(FRONT, "immersive-ar"), open(FRONT, "immersive-vr"), open(room, "immersive-vr")]).toEqual([true, true, true]);
  expect(open(room, "immersive-ar")).toBe(false);
  choices.choose(room, true, "immersive-ar");
  choices.choose(FRONT, false, "immersive-ar");
  expect([open(room, "immersive-ar"), open(FRONT, "immersive-ar"), open(FRONT, "screen")]).toEqual([true, false, true]);
  choices.choose(room, false, "immersive-vr");
  expect([open(room, "screen"), open(room, "immersive-ar")]).toEqual([false, true]);
});

test("what was chosen by hand wins, in AR what was chosen for AR", () => {
  choices.choose(TABLE, false, "screen");
  expect(choices.listWanted(STREAMS, "screen")).not.toContain("table");
  expect(choices.listWanted(STREAMS, "immersive-ar")).not.toContain("table");
  choices.choose(ROOM, true, "immersive-ar");
  expect(choices.listWanted(STREAMS, "immersive-ar")).toContain("room");
  choices.choose(ROOM, false, "screen");
  expect(choices.listWanted(STREAMS, "screen")).not.toContain("room");
  expect(choices.listWanted(STREAMS, "immersive-ar")).toContain("room");
  choices.choose(ROOM, false, "immersive-ar");
  expect(choices.listWanted(STREAMS, "immersive-ar")).not.toContain("room");
});

test("a cloud switched on on the screen is still left out in AR: it was chosen where the room is not seen", () => {
  choices.choose(ROOM, true, "screen");
  expect(choices.listWanted(STREAMS, "immersive-ar")).not.toContain("room");
});

test("one panel too many closes the oldest one", () => {
  const cameras = Array.from({ length: MAX_PANELS + 1 }, (_, i) => makeStream(`camera${i}`, "jpeg"));
  for (const camera of cameras) choices.choose(camera, true, "screen");
  expect(choices.listPanels(cameras, "screen").map(({ stream }) => stream)).toEqual(["camera1", "camera2", "camera3", "camera4"]);
  choices.choose(cameras[2]!, true, "screen");
  expect(choices.listPanels(cameras, "screen")).toHaveLength(MAX_PANELS);
});

test("without a picture of the scene only panels are wanted", () => {
  choices = new StreamChoices(() => ["cloth"], () => false);
  choices.choose(FRONT, true, "screen");
  expect(choices.listWanted(STREAMS, "screen")).toEqual(["front"]);
});
