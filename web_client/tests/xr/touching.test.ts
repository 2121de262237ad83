// Touched marks: the procedure from frame to frame, what it reports, and what it says; arithmetic of poses; what is kept.

import { beforeEach, describe, expect, test, vi } from "vitest";

import type { AnchorPlace, ObservationInput, ParticipantInfo } from "../../src/core/api.ts";
import { MemoryStore } from "../../src/core/storage.ts";
import type * as wire from "../../src/protocol/messages.g.ts";
import { keepTips, PlaceKeeper, recallTips } from "../../src/xr/kept_places.ts";
import { compose, covarianceAtAnchor, fitLevel, IDENTITY, invert, transform } from "../../src/xr/poses.ts";
import { BUTTON, type FrameReading, type InputReading, type Vec3 } from "../../src/xr/reading.ts";
import { BEGIN_MS, type Facts, type Outcome, REST_MS, TIP_POSES, Touching } from "../../src/xr/touching.ts";

type Alignment = NonNullable<ParticipantInfo["alignment"]>;

const TIP: Vec3 = [0.1, 0, -0.02];
const marks = Object.entries({ 1: [0.1, 0.1, 0], 2: [-0.1, -0.1, 0], 3: [0.1, -0.1, 0], 4: [-0.1, 0.1, 0] } as const).map(([id, p]) => ({ id, p_anchor: [...p] as [number, number, number] }));
const anchor: AnchorPlace = { anchor_id: "table", T_world_anchor: [[1, 2, 0.7], [1, 0, 0, 0]], size_m: 0.14, error_m: 0, marks };
const T_world_tracking: wire.Pose = [[0.5, -0.3, 0.1], [Math.cos(0.4), 0, 0, Math.sin(0.4)]];
const alignment = { version: 1, kind: "measured", error_at_robot_m: 0.006, offset: false, T_world_tracking } as Alignment;
const at = (mark: string): Vec3 => transform(invert(T_world_tracking), transform(anchor.T_world_anchor, marks.find(({ id }) => id === mark)!.p_anchor));

let touching: Touching;
let facts: Facts;
let now = 0;
beforeEach(() => {
  touching = new Touching();
  facts = { anchor, alignment: undefined, isReady: true, isOffered: true, busy: [] };
  now = 1000;
});

function controller(fields: Partial<InputReading> = {}): InputReading {
  return { side: "right", kind: "controller", pose: IDENTITY, tracked: true, emulated: false, ray: null, trigger: 0, squeeze: 0, buttons: 0, tip: null, joints: [], ...fields };
}

function hand(side: InputReading["side"], fingertip: Vec3, trigger = 0): InputReading {
  return controller({ side, kind: "hand", tip: fingertip, trigger });
}

function reading(...inputs: InputReading[]): FrameReading {
  now += 20;
  return { capture_ms: now, head: IDENTITY, headTracked: true, headEmulated: false, inputs, stops: [] };
}

const step = (...inputs: InputReading[]): Outcome[] => touching.update(reading(...inputs), facts);
const says = (): string => touching.describe(facts, now, "").join(" ");
const observed = (outcomes: Outcome[]): ObservationInput[] => outcomes.flatMap((one) => (one.type === "observe" ? [one.observation] : []));
/** Where the controller is when its tip is at a point. */
const tipAt = (p: Vec3): wire.Pose => [[p[0] - TIP[0], p[1] - TIP[1], p[2] - TIP[2]], [1, 0, 0, 0]];

function knowTip(): void {
  touching.tips.set("controller/right", { p: TIP, covariance: [1e-7, 0, 0, 0, 1e-7, 0, 0, 0, 1e-7], error_m: 0.001 });
}

/** Hold the trigger with the tip at a point until it is reported. */
function touch(p: Vec3): ObservationInput[] {
  step(controller());
  const found: ObservationInput[] = [];
  for (let i = 0; i <= REST_MS / 20 + 2 && found.length === 0; i++) found.push(...observed(step(controller({ pose: tipAt(p), trigger: 1 }))));
  return found;
}

/** A turn of the controller that is another one for every i. */
const turned = (i: number): wire.Pose => {
  const [tilt, direction] = [0.6 * Math.sqrt((i % 300) / 300), 0.3 * i];
  return [[0, 0, 1], [Math.cos(tilt / 2), Math.sin(tilt / 2) * Math.cos(direction), Math.sin(tilt / 2) * Math.sin(direction), 0]];
};

describe("the tip", () => {
  test("different turns of the controller are reported, and the answer is stated", () => {
    step(controller());
    expect(says()).toMatch(/^Calibrate the tip of a controller .*pricked hole of the sheet 'table'/);
    step(controller({ trigger: 1 }));
    const found: ObservationInput[] = [];
    let frames = 0;
    for (; frames < 3000 && found.length === 0; frames++) found.push(...observed(step(controller({ pose: turned(Math.floor(frames / 3)) }))));
    expect(found).toHaveLength(1);
    expect(found[0]).toMatchObject({ kind: "tip", anchor_id: "", device: "controller/right", T_tracking_anchor: IDENTITY });
    expect(found[0]!.grip_poses).toHaveLength(TIP_POSES);
    expect(frames).toBeGreaterThan(TIP_POSES); // equal ones do not count
    const answer = { event: "tip_calibrated", participant: "p1", device: "controller/right", residual_m: 0, n_poses: 80 } as const;
    touching.onTip({ ...answer, refused: true, advice: "the tip slipped", p_grip_tip: [0, 0, 0], covariance: [], error_m: 0 });
    step(controller());
    expect(says()).toMatch(/^Calibrate the tip of a controller the tip slipped/);
    step(controller({ trigger: 1 }));
    for (frames = 0; frames < 3000 && !says().includes("computes"); frames++) step(controller({ pose: turned(frames) }));
    touching.onTip({ ...answer, refused: false, advice: "", p_grip_tip: [...TIP], covariance: new Array<number>(9).fill(0), error_m: 0.0012 });
    expect(says()).toMatch(/^Touch mark 1 \(1 of 4\) The tip is known to ± 1.2 mm./);
  });

  test("too few turns are not reported; no answer is said", () => {
    step(controller());
    step(controller({ trigger: 1 }));
    step(controller());
    expect(observed(step(controller({ trigger: 1 })))).toEqual([]);
    expect(says()).toMatch(/too little/);
    step(controller());
    step(controller({ trigger: 1 }));
    for (let i = 0; i < 3000 && !says().includes("computes"); i++) step(controller({ pose: turned(i) }));
    now += 5000;
    step(controller());
    expect(says()).toMatch(/did not answer/);
  });
});

describe("comparison", () => {
  test("an aligned headset reports a point under a squeeze, and hears how far apart two worlds are", () => {
    knowTip();
    const squeeze = (p: Vec3): ObservationInput[] => {
      step(controller());
      const found: ObservationInput[] = [];
      for (let i = 0; i <= REST_MS / 20 + 2 && found.length === 0; i++) found.push(...observed(step(controller({ pose: tipAt(p), squeeze: 1 }))));
      return found;
    };
    touching.begin();
    expect(squeeze([1, 0, 0])).toEqual([]); // not aligned: there is nothing to compare
    facts.alignment = alignment;
    step(controller());
    expect(says()).toMatch(/Squeeze: compare/);
    const [point] = squeeze([1, 0.2, 0.3]);
    expect(point).toMatchObject({ kind: "point", anchor_id: "point", device: "controller/right" });
    point!.T_tracking_anchor[0].forEach((value, i) => expect(value).toBeCloseTo([1, 0.2, 0.3][i]!, 9));
    expect(point!.covariance).toHaveLength(36);
    touching.onCompared("Bob", { event: "headsets_compared", a: "p1", b: "p2", anchor_id: "point", error_m: 0.0062, error_rad: 0, expected_p95_m: 0.014, p_world: [0, 0, 0], n: 1, touched: true });
    expect(says()).toMatch(/You and Bob are 6.2 mm apart at the touched point: expected at most 14/);
    expect(touch(at("1"))[0]).toMatchObject({ kind: "touch", mark: "1" }); // marks go on
  });
});

describe("touches", () => {
  test("each mark in turn, as the mean of a moment of rest, with the error of the tip", () => {
    knowTip();
    const [first] = touch(at("1"));
    expect(first).toMatchObject({ kind: "touch", anchor_id: "table", mark: "1", device: "controller/right" });
    first!.T_tracking_anchor[0].forEach((value, i) => expect(value).toBeCloseTo(at("1")[i]!, 9));
    expect(first!.covariance).toHaveLength(36);
    expect(Math.sqrt(first!.covariance![0]!)).toBeCloseTo(0.0016, 4);
    expect(touching.findExpected(facts)).toBeNull();
    touch(at("2"));
    const expected = touching.findExpected(facts)!; // two marks tell where the others are
    expect(expected.mark).toBe("3");
    expected.pose[0].forEach((value, i) => expect(value).toBeCloseTo(at("3")[i]!, 9));
    touch(at("3"));
    facts.alignment = alignment;
    step(controller());
    expect(says()).toMatch(/^Touch mark 4 \(4 of 4\) So far: aligned ± 6.0 mm at the robot/);
    touch(at("4"));
    now += 2000;
    expect(step(controller())).toEqual([{ type: "finish", anchor, isConfirmed: false, isMeasured: true }]);
    expect(touching.isActive).toBe(false);
    expect(says()).toBe("Aligned ± 6.0 mm at the robot");
  });

  test("a tip that moves, or a trigger that is let go, is no touch", () => {
    knowTip();
    step(controller());
    for (let i = 0; i < 60; i++) expect(observed(step(controller({ pose: tipAt([0.01 * i, 0, 0]), trigger: 1 })))).toEqual([]);
    step(controller());
    expect(says()).toMatch(/Keep the trigger pressed/);
  });

  test("a refusal is said, and what it names is touched again: once at once, then at the end", () => {
    knowTip();
    touch(at("1"));
    touch(at("2"));
    touch(at("3"));
    touching.onRefused("alignment of eve refused: the anchor measurement is not good enough; point 'table/2' does not fit the others: touch it again");
    expect(says()).toMatch(/^Touch mark 2 \(3 of 4\) the anchor measurement is not good enough; point 'table\/2' does not fit/);
    touch(at("2"));
    touching.onRefused("point 'table/2' does not fit the others: touch it again");
    expect(says()).toMatch(/^Touch mark 4/);
    expect(touch(at("4"))[0]!.mark).toBe("4");
    expect(touch(at("2"))[0]!.mark).toBe("2");
    touching.onRefused("distances between points are wrong: touch all of them again");
    expect(says()).toMatch(/^Touch mark 1/);
  });

  test("no answer to all of them: once more", () => {
    knowTip();
    for (const mark of "1234") touch(at(mark));
    expect(says()).toMatch(/computes/);
    now += 5000;
    step(controller());
    expect(says()).toMatch(/^Touch mark 1 .*did not answer/);
  });

  test("a fingertip touches while the other hand pinches, without an error of its own", () => {
    step(hand("left", [0, 0, 0]), hand("right", [0.3, 0, 0.7]));
    expect(says()).toMatch(/fingertip on cross 1 .*to look; to drive/);
    knowTip(); // of a controller that was put down
    expect(says()).toMatch(/fingertip on cross 1/);
    const found: ObservationInput[] = [];
    for (let i = 0; i < 30; i++) found.push(...observed(step(hand("left", [0, 0, 0], 1), hand("right", [0.3, 0, 0.7]))));
    expect(found).toHaveLength(1);
    expect(found[0]).toMatchObject({ device: "hand/right", mark: "1", covariance: [] });
    found[0]!.T_tracking_anchor[0].forEach((value, i) => expect(value).toBeCloseTo([0.3, 0, 0.7][i]!, 9));
  });

  test("a kept place is confirmed by one mark, where it is expected", () => {
    knowTip();
    facts.alignment = { ...alignment, kind: "persistent" };
    step(controller());
    expect(says()).toMatch(/^Touch mark 1: it confirms the kept place/);
    touching.findExpected(facts)!.pose[0].forEach((value, i) => expect(value).toBeCloseTo(at("1")[i]!, 9));
    touch(at("1"));
    facts.alignment = alignment;
    expect(step(controller())).toEqual([{ type: "finish", anchor, isConfirmed: true, isMeasured: false }]);
  });

  test("fewer than three marks, or an alignment of before, are no new place", () => {
    const leave = (): Outcome[] => step(controller({ buttons: BUTTON.upper }));
    const finished = { type: "finish", anchor, isConfirmed: false, isMeasured: false };
    knowTip();
    facts.alignment = alignment;
    step(controller());
    touching.begin();
    touch(at("1"));
    expect(leave()).toEqual([finished]);
    step(controller());
    touching.begin();
    for (const mark of "123") touch(at(mark));
    expect(leave()).toEqual([finished]); // the session has not taken these touches
  });

  test("a session that is joined again knows nothing of the touches", () => {
    knowTip();
    step(controller());
    touch(at("1"));
    expect(says()).toMatch(/^Touch mark 2 /);
    facts.isReady = false;
    step(controller());
    facts.isReady = true;
    step(controller());
    expect(says()).toMatch(/^Touch mark 1 /);
  });
});

describe("begin and end", () => {
  test("it is offered to a headset that is not aligned, and declined by B", () => {
    facts.isOffered = false;
    step(controller());
    expect(touching.isActive).toBe(false);
    facts.isOffered = true;
    step(controller());
    expect(touching.isActive).toBe(true);
    step(controller({ buttons: BUTTON.upper }));
    step(controller());
    expect(touching.isActive).toBe(false);
    touching.reset(); // another tracking frame: offered again
    step(controller());
    expect(touching.isActive).toBe(true);
    facts.alignment = { ...alignment, kind: "placed" };
    step(controller());
    expect(touching.isActive).toBe(false);
  });

  test("a trigger held at nothing asks for a new alignment, once", () => {
    knowTip();
    facts.alignment = alignment;
    step(controller());
    step(controller({ trigger: 1 }));
    expect(step(controller({ trigger: 1 }))).toEqual([]);
    now += BEGIN_MS;
    expect(step(controller({ trigger: 1 }))).toEqual([{ type: "restart" }]);
    expect(step(controller({ trigger: 1 }))).toEqual([]);
    touching.begin();
    step(controller({ trigger: 1 }));
    expect(says()).toMatch(/^Touch mark 1 \(1 of 4\)/);
  });

  test("a trigger at a robot, and one while squeezing, do not", () => {
    facts.alignment = alignment;
    facts.busy = ["right"];
    step(controller());
    step(controller({ trigger: 1 }));
    now += 2 * BEGIN_MS;
    expect(step(controller({ trigger: 1 }))).toEqual([]);
    facts.busy = [];
    step(controller());
    step(controller({ trigger: 1, squeeze: 1 }));
    now += 2 * BEGIN_MS;
    expect(step(controller({ trigger: 1, squeeze: 1 }))).toEqual([]);
  });

  test("touches end with the tracking frame, tips do not", () => {
    knowTip();
    touch(at("1"));
    touching.reset();
    step(controller());
    expect(says()).toMatch(/^Touch mark 1 \(1 of 4\)/);
    for (const mark of "123") touch(at(mark));
    facts.alignment = alignment;
    step(controller());
    expect(says()).toMatch(/^Touch mark 4/);
    facts.alignment = undefined; // the session voids the alignment
    step(controller());
    expect(says()).toMatch(/^Touch mark 1 \(1 of 4\)/);
  });
});

describe("poses", () => {
  test("composing with the inverse is the identity", () => {
    const [p, q] = compose(T_world_tracking, invert(T_world_tracking));
    [...p, ...q].forEach((value, i) => expect(value).toBeCloseTo([0, 0, 0, 1, 0, 0, 0][i]!, 12));
  });

  test("the covariance of an alignment at a sheet on a wall, in its axes", () => {
    const covariance = [1, 4, 9, 100, 400, 900].flatMap((value, i) => Array.from({ length: 6 }, (_, k) => (k === i ? value : i + k === 5 && i * k === 0 ? 10 : 0)));
    const half = Math.SQRT1_2;
    const kept = covarianceAtAnchor({ covariance, pivot_world: [1, 2, 0.5] }, [[1.3, 2.1, 1], [half, 0, half, 0]]);
    // From `covariance_at_anchor` in anchors/persistent.py.
    const expected = [
      [46, 5, 60, 0, 120, -10],
      [5, 110, -24, -270, 0, -50],
      [60, -24, 108, 80, 200, 0],
      [0, -270, 80, 900, 0, 0],
      [120, 0, 200, 0, 400, 0],
      [-10, -50, 0, 0, 0, 100],
    ].flat();
    kept.forEach((value, i) => expect(value).toBeCloseTo(expected[i]!, 9));
    expect(covarianceAtAnchor({ covariance: [], pivot_world: [0, 0, 0] }, IDENTITY)).toEqual([]);
  });

  test("points on one vertical tell no turn", () => {
    expect(fitLevel([{ from: [0, 0, 0], to: [1, 1, 1] }, { from: [0, 0, 1], to: [1, 1, 2] }])).toBeNull();
  });
});

describe("what is kept", () => {
  const space = {} as XRReferenceSpace;
  /** Keeps values after the page has ended, as long as there is room. */
  class Disk extends MemoryStore {
    isFull = false;
    override async putValue(key: string, bytes: Uint8Array): Promise<boolean> {
      if (!this.isFull) await super.putValue(key, bytes);
      return !this.isFull;
    }
  }
  const place = { transform: { position: { x: 0, y: 0, z: -1 }, orientation: { x: 0, y: Math.SQRT1_2, z: 0, w: Math.SQRT1_2 } } };

  test("tips of the same participant of the same session", async () => {
    const store = new MemoryStore();
    knowTip();
    keepTips(store, "s1 p1", touching.tips);
    expect(await recallTips(store, "s1 p1")).toEqual([...touching.tips]);
    expect(await recallTips(store, "s2 p1")).toEqual([]);
  });

  test("a place comes back with its covariance when the headset has found it; the former one is deleted", async () => {
    vi.stubGlobal("XRRigidTransform", class {});
    const store = new Disk();
    let [deleted, handles] = [0, 0];
    const made = { anchorSpace: {}, requestPersistentHandle: async () => `handle ${++handles}`, delete: () => (deleted += 1) } as unknown as XRAnchor;
    const deletePersistentAnchor = vi.fn(async (_: string) => undefined);
    const session = { restorePersistentAnchor: async () => made, deletePersistentAnchor } as unknown as XRSession;
    const tracked = new Set<XRAnchor>();
    const frame = { createAnchor: async () => made, trackedAnchors: tracked, getPose: () => place } as unknown as XRFrame;
    const C = Array.from({ length: 36 }, (_, i) => (i % 7 === 0 ? 1e-6 * i : 0)); // axes of the sheet, wherever it lies now
    const before = new PlaceKeeper(session, store, "lab");
    expect(await before.keep(frame, space, "table", IDENTITY, C)).toBe(true);
    const after = new PlaceKeeper(session, store, "lab");
    await after.restore();
    expect(after.observe(frame, space, 5)).toBeNull(); // the headset has not found it yet
    tracked.add(made);
    const found = after.observe(frame, space, 5)!;
    expect(found).toMatchObject({ anchor_id: "table", kind: "persistent", covariance: C, capture_ms: 5 });
    found.T_tracking_anchor[0].forEach((value, i) => expect(value).toBeCloseTo([1, 0, 0][i]!, 12));
    store.isFull = true;
    expect(await after.keep(frame, space, "table", IDENTITY, C)).toBe(false);
    expect(deleted).toBe(1);
    expect(deletePersistentAnchor.mock.calls).toEqual([["handle 2"]]); // the new one, not the former: headsets keep few
    store.isFull = false;
    await after.keep(frame, space, "table", IDENTITY, C);
    expect(deletePersistentAnchor).toHaveBeenLastCalledWith("handle 1");
    const elsewhere = new PlaceKeeper(session, store, "other lab");
    await elsewhere.restore();
    expect(elsewhere.observe(frame, space, 5)).toBeNull();
  });

  test("what is damaged is not used", async () => {
    const store = new Disk();
    const bytes = (value: object): Uint8Array => new TextEncoder().encode(JSON.stringify(value));
    for (const tips of [null, [null], [["controller/right", null]], [["controller/right", { p: [0, 0], covariance: [], error_m: 0 }]]]) {
      await store.putValue("tips", bytes({ owner: "s1 p1", tips }));
      expect(await recallTips(store, "s1 p1")).toEqual([]);
    }
    const found = {} as XRAnchor;
    const session = { restorePersistentAnchor: async () => found } as unknown as XRSession;
    const frame = { trackedAnchors: new Set([found]), getPose: () => place } as unknown as XRFrame;
    const whole = { anchor_id: "table", handle: "handle", covariance: Array<number>(36).fill(0) };
    for (const [damage, isUsed] of [[{}, true], [{ covariance: [null] }, false], [{ anchor_id: 5 }, false], [{ handle: null }, false]] as const) {
      await store.putValue("place lab", bytes({ ...whole, ...damage }));
      const keeper = new PlaceKeeper(session, store, "lab");
      await keeper.restore();
      expect(keeper.observe(frame, space, 5) !== null).toBe(isUsed);
    }
  });

  test("a browser without anchors keeps nothing, and says so", async () => {
    vi.stubGlobal("XRRigidTransform", class {});
    const keeper = new PlaceKeeper({} as XRSession, new MemoryStore(), "lab");
    expect(await keeper.keep({} as XRFrame, space, "table", IDENTITY, [])).toBe(false);
    await keeper.restore();
    expect(keeper.observe({} as XRFrame, space, 5)).toBeNull();
  });
});
