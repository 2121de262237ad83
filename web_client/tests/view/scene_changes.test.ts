// What is in the picture while a changed scene is loaded: the scene before, and it moves.

import { Box3, Group, type Mesh, Scene } from "three";
import { beforeEach, expect, test } from "vitest";

import type { FromWorker, SceneSpec, ToWorker } from "../../src/core/api.ts";
import { encodeStruct } from "../../src/core/codec.ts";
import { WorkerClient, type WorkerPort } from "../../src/core/page_client.ts";
import { decodeScene } from "../../src/core/scene.ts";
import { SheetBuilder } from "../../src/core/sheet.ts";
import { WorkerAssets } from "../../src/view/assets.ts";
import { DESKTOP } from "../../src/view/budget.ts";
import { FrameBuffer } from "../../src/view/interpolation.ts";
import { Shadows } from "../../src/view/shadows.ts";
import { View } from "../../src/view/view.ts";

const REST = [[0, 0, 0], [1, 0, 0, 0]];
const LOOK = { group: 0, material: -1, rgba: [1, 1, 1, 1] };

/** The cloth of the scenes, as the worker builds it. */
const SHEET = new SheetBuilder({ dim: 2, radius: 0, flat: true }, 3, { elements: Uint16Array.of(0, 1, 2) });

const addressOf = (kind: string, look: string): string => kind + look.repeat(63);

/** A scene of one body with a mesh and a cloth. `look`: a hexadecimal digit, its assets are its own. */
function makeSpec(look: string, name = "room"): SceneSpec {
  const level = { address: addressOf("0", look), bytes: 1, encoding: "arrays", vertices: 3, triangles: 1 };
  return decodeScene(
    encodeStruct("SceneSpec", {
      name,
      bodies: [{ id: 1, name: "hand", parent: -1, T_parent_body: REST, T_world_body: REST, moving: true }],
      meshes: [{ name: look, low: [0, 0, 0], high: [1, 1, 1], textured: false, levels: [level] }],
      visuals: [{ id: 1, body: 1, name: look, T_body_visual: REST, geometry: { kind: "mesh", size: [1, 1, 1], mesh: 0 }, ...LOOK }],
      deformables: [{ name: "cloth", dim: 2, vertices: 3, elements: 1, radius: 0, flat: true, stream: "cloth", address: addressOf("1", look), bytes: 1, ...LOOK }],
    }),
  );
}

/** A view without a graphics card. */
class Stage {
  posted: ToWorker[] = [];
  shownSpecs: string[] = [];
  problems: string[] = [];
  root = new Scene();
  session_ms = 0;
  private readonly port: WorkerPort = {
    postMessage: (message, transfer) => this.posted.push(structuredClone(message, { transfer })),
    onmessage: null,
  };
  private readonly client = new WorkerClient(this.port);
  readonly view = Object.assign(Object.create(View.prototype) as View, {
    client: this.client,
    assets: new WorkerAssets(this.client),
    canvas: { clientHeight: 100 },
    events: { onScene: (spec: SceneSpec) => this.shownSpecs.push(spec.visuals[0]?.name ?? ""), onProblem: (text: string) => this.problems.push(text), measureTop: () => 0 },
    root: this.root,
    overlay: new Group(),
    frames: new FrameBuffer(),
    streams: new Map(),
    contentCount: 0,
    sceneCount: 0,
    scene: null,
    next: null,
    headset: null,
    poses: new Float32Array(0),
    drawnPoses: new Float32Array(0),
    bodyIds: [],
    bases: [],
    device: { budget: DESKTOP, framePeriod_ms: 0 },
    delay: { delay_ms: 0, add: () => undefined },
    avatars: { update: () => false },
    viewpoint: { update: () => false, frame: () => undefined, camera: {} },
    clouds: { group: new Group(), popChanged: () => false, getBounds: () => new Box3() },
    shadows: new Shadows({ autoUpdate: true, needsUpdate: false }, 0),
    pictures: { markOutdated: () => undefined, drawDue: () => false, show: () => undefined },
    renderer: { capabilities: { getMaxAnisotropy: () => 1 }, xr: { getReferenceSpace: () => null, isPresenting: false }, render: () => undefined },
    sessionTime: () => this.session_ms,
    lastTried_ms: Number.NEGATIVE_INFINITY,
  });

  constructor() {
    (this.view as unknown as { listen(): void }).listen();
    this.say({ type: "bodies", version: 1, scene_epoch: 1, bodies: [[1, "hand", true]] });
  }

  say(update: object): void {
    this.port.onmessage?.({ data: update } as MessageEvent<FromWorker>);
  }

  setScene(spec: SceneSpec): void {
    this.say({ type: "scene", spec });
  }

  /** The assets of a look arrive. */
  async load(look: string): Promise<void> {
    const position = { data: Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0) };
    const triangle = { data: Uint16Array.of(0, 1, 2) };
    this.say({ type: "asset", address: addressOf("0", look), arrays: { position, normal: position, index: triangle } });
    this.say({ type: "asset", address: addressOf("1", look), arrays: { position, elements: triangle } });
    await settle();
  }

  /** Move body and cloth to x, and draw. */
  move(x: number): void {
    this.session_ms += 10;
    const { session_ms } = this;
    this.say({ type: "frame", bodies_version: 1, session_ms, age_ms: 0, poses: Float32Array.of(x, 0, 0, 1, 0, 0, 0) });
    const vertices = new Float32Array(9).fill(x);
    this.say({ type: "deformable", stream: "cloth", session_ms, vertices, surface: SHEET.build(vertices) });
    (this.view as unknown as { draw(): void }).draw();
  }

  /** What is in the picture: looks, with where the body and the first point of the cloth are. */
  see(): [string, number, number][] {
    return this.root.children.map((world) => {
      const [look] = world.getObjectByName("hand")!.children;
      const cloth = world.getObjectByName("cloth") as Mesh;
      return [look!.name, world.getObjectByName("hand")!.position.x, cloth.geometry.getAttribute("position").getX(0)];
    });
  }
}

/** Let promises settle. */
function settle(): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, 0));
}

let stage: Stage;
beforeEach(async () => {
  stage = new Stage();
  stage.setScene(makeSpec("a"));
  await settle();
  await stage.load("a");
});

test("the scene moves while a changed one is loaded, which is where it should be when it appears", async () => {
  stage.move(1);
  expect(stage.see()).toEqual([["a", 1, 1]]);
  stage.setScene(makeSpec("b"));
  await settle();
  stage.move(2);
  expect(stage.see()).toEqual([["a", 2, 2]]);
  expect(stage.shownSpecs).toEqual(["a"]);
  await stage.load("b");
  stage.move(2); // nothing moves any more
  expect(stage.see()).toEqual([["b", 2, 2]]);
  expect(stage.shownSpecs).toEqual(["a", "b"]);
});

test("a changed scene that is changed again before it was loaded is never shown, and the scene before stays until then", async () => {
  stage.setScene(makeSpec("b"));
  await settle();
  stage.setScene(makeSpec("c"));
  await stage.load("b");
  stage.move(1);
  expect(stage.see()).toEqual([["a", 1, 1]]);
  await stage.load("c");
  stage.move(2);
  expect(stage.see()).toEqual([["c", 2, 2]]);
  expect([stage.shownSpecs, stage.problems]).toEqual([["a", "c"], []]);
});

test("a scene of another room appears at once, and a change of the room before is never shown", async () => {
  stage.setScene(makeSpec("b"));
  await settle();
  stage.setScene(makeSpec("c", "another room"));
  expect(stage.root.children).toHaveLength(1);
  expect(stage.shownSpecs).toEqual(["a", "c"]);
  await stage.load("c");
  stage.move(1);
  expect(stage.see()).toEqual([["c", 1, 1]]);
});

test("every surface is given back when its frame is over, and those of a scene that is gone", async () => {
  const back = (): number => stage.posted.filter((message) => message.type === "recycle_surface").length;
  for (let x = 1; x <= 10; x++) stage.move(x);
  expect(back()).toBe(9); // one is drawn
  expect(stage.see()).toEqual([["a", 10, 10]]);
  stage.setScene(decodeScene(encodeStruct("SceneSpec", { name: "an empty room" })));
  await settle();
  expect(back()).toBe(10);
});

test("a cloth at rest is drawn anew when it is drawn otherwise", async () => {
  stage.move(1);
  stage.setScene(makeSpec("b"));
  await settle();
  await stage.load("b");
  stage.move(1);
  expect(stage.see()).toEqual([["b", 1, 1]]);
});
