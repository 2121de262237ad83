// Point clouds in the scene: what goes to the graphics card, and where it lies there.

import type { BufferGeometry, InterleavedBufferAttribute, Points, ShaderMaterial } from "three";
import { Vector3 } from "three";
import { expect, test } from "vitest";

import { decodeCloud } from "../../src/core/cloud.ts";
import { CloudViews } from "../../src/view/clouds.ts";
import { fromHex, readGolden } from "../golden.ts";

interface Frame {
  name: string;
  hex: string;
  positions: number[][];
}

const { frames } = readGolden<{ frames: Frame[] }>("cloud");
const findFrame = (name: string): Frame => frames.find((frame) => frame.name === name) as Frame;

function readPlaces(views: CloudViews, stream: string): number[][] {
  const object = views.group.getObjectByName(stream) as Points<BufferGeometry>;
  object.updateMatrix();
  const nodes = object.geometry.getAttribute("position") as InterleavedBufferAttribute;
  return Array.from({ length: object.geometry.drawRange.count }, (_, i) =>
    new Vector3(nodes.getX(i), nodes.getY(i), nodes.getZ(i)).applyMatrix4(object.matrix).toArray(),
  );
}

test("points lie where the frame has them, and a later frame replaces them", () => {
  const views = new CloudViews(1000);
  views.setWanted(["room"]);
  for (const name of ["on a table/full", "a room/full", "on a table/quarter", "no point/full"]) {
    const { hex, positions } = findFrame(name);
    views.show("room", decodeCloud(fromHex(hex)));
    const places = readPlaces(views, "room");
    expect(places).toHaveLength(positions.length);
    for (const [i, place] of places.entries()) for (const axis of [0, 1, 2]) expect(place[axis]).toBeCloseTo(positions[i]![axis]!, 5);
    expect(views.popChanged()).toBe(true);
    expect(views.popChanged()).toBe(false);
  }
});

test("a device draws as many points as it can, of all clouds together", () => {
  const views = new CloudViews(20);
  views.setWanted(["left", "right"]);
  const { hex } = findFrame("on a table/full");
  views.show("left", decodeCloud(fromHex(hex)));
  expect(views.drawn).toEqual(new Map([["left", 20]]));
  views.show("right", decodeCloud(fromHex(hex)));
  views.show("left", decodeCloud(fromHex(hex)));
  expect(views.drawn).toEqual(new Map([["left", 10], ["right", 10]]));
});

test("clouds at rest share what the device draws, and what is left has more", () => {
  const views = new CloudViews(24);
  const { hex, positions } = findFrame("on a table/full");
  const readEdge = (name: string): number => (views.group.getObjectByName(name) as Points<BufferGeometry, ShaderMaterial>).material.uniforms.edge!.value as number;
  views.setWanted(["a", "b", "c"]);
  for (const stream of ["a", "b", "c"]) views.show(stream, decodeCloud(fromHex(hex)));
  expect(views.drawn).toEqual(new Map([["a", 8], ["b", 8], ["c", 8]]));
  expect(readEdge("a")).toBe(readEdge("c"));
  const edge = readEdge("a");
  views.setWanted(["a"]);
  expect(views.drawn).toEqual(new Map([["a", 24]]));
  expect(readEdge("a")).toBeCloseTo(edge / Math.sqrt(3), 9);
  const places = readPlaces(views, "a");
  for (const [i, place] of places.entries()) for (const axis of [0, 1, 2]) expect(place[axis]).toBeCloseTo(positions[i]![axis]!, 5);
});

test("a cloud that is not wanted any more is gone, also when a frame of it was on its way", () => {
  const views = new CloudViews(20);
  views.setWanted(["room"]);
  const cloud = decodeCloud(fromHex(findFrame("on a table/full").hex));
  views.show("room", cloud);
  views.setWanted([]);
  views.show("room", cloud);
  expect(views.drawn.size).toBe(0);
  expect(views.group.children).toHaveLength(0);
});

test("a cloud that is stale or faulty is dimmed, until it is not", () => {
  const views = new CloudViews(20);
  const readDimmed = (): number => (views.group.getObjectByName("room") as Points<BufferGeometry, ShaderMaterial>).material.uniforms.dimmed!.value as number;
  views.setWanted(["room"], ["room"]);
  views.show("room", decodeCloud(fromHex(findFrame("on a table/full").hex)));
  expect(readDimmed()).toBe(1);
  views.popChanged();
  views.setWanted(["room"], ["room"]);
  expect(views.popChanged()).toBe(false);
  views.setWanted(["room"], []);
  expect(readDimmed()).toBe(0);
  expect(views.popChanged()).toBe(true);
});

test("the box around all that is drawn holds every point of every cloud, and is empty without any", () => {
  const views = new CloudViews(1000);
  views.setWanted(["table", "room", "nothing"]);
  expect(views.getBounds().isEmpty()).toBe(true);
  views.show("nothing", decodeCloud(fromHex(findFrame("no point/full").hex)));
  expect(views.getBounds().isEmpty()).toBe(true);
  const shown = { table: findFrame("on a table/full"), room: findFrame("a room/full") };
  for (const [stream, { hex }] of Object.entries(shown)) views.show(stream, decodeCloud(fromHex(hex)));
  const all = Object.values(shown).flatMap(({ positions }) => positions);
  const { min, max } = views.getBounds();
  for (const [axis, name] of (["x", "y", "z"] as const).entries()) {
    expect(min[name]).toBeCloseTo(Math.min(...all.map((point) => point[axis]!)), 5);
    expect(max[name]).toBeCloseTo(Math.max(...all.map((point) => point[axis]!)), 5);
  }
  views.setWanted([]);
  expect(views.getBounds().isEmpty()).toBe(true);
});

test("a cloud tells how many of its points are drawn", () => {
  const views = new CloudViews(20);
  views.setWanted(["room"]);
  const { hex, positions } = findFrame("on a table/full");
  views.show("room", decodeCloud(fromHex(hex)));
  expect(views.getPoints("room")).toMatchObject({ drawn: 20, points: positions.length });
  expect(views.getPoints("other")).toBeUndefined();
});
