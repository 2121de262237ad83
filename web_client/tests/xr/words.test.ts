// Panels in the scene and what a hand feels.

import { describe, expect, test } from "vitest";

import type { Lease, ParticipantInfo } from "../../src/core/api.ts";
import { describeMissing } from "../../src/xr/controls.ts";
import { describeAlignment, describeConsent, describeHand, describeRobot, describeUrgent, findPulse, isPlaced, wrap } from "../../src/xr/words.ts";

const facts = { name: "left", lease: undefined, holdReason: "", limits: [], selfId: "p1", isStopped: false, isPaused: false, nameOf: () => "ben", isPointedAt: false, isOwn: false, isRequested: false };
const lease = { target: "left", holder: "p2", queue: [] as string[] } as unknown as Lease;

describe("panels", () => {
  test("at a robot: holder, why it holds, what the trigger does", () => {
    expect(describeRobot(facts)).toEqual(["left: free"]);
    expect(describeRobot({ ...facts, isPointedAt: true })).toEqual(["left: free", "press the trigger to take it"]);
    expect(describeRobot({ ...facts, lease, holdReason: "clutch_open" })).toEqual(["left: ben", "holds: the operator has let go"]);
    const own = { ...facts, lease, isOwn: true, isPointedAt: true, holdReason: "untracked" };
    expect(describeRobot(own)).toEqual(["left: you", "holds: tracking lost", "hold the trigger to release it"]);
    expect(describeRobot({ ...own, holdReason: "clutch_open" })[1]).toBe("squeeze to move it");
    expect(describeRobot({ ...own, holdReason: "gap" }).join(" ")).toContain("then squeeze again");
    expect(describeRobot({ ...own, isStopped: true })[1]).toBe("stopped by the e-stop");
    expect(describeRobot({ ...own, isPaused: true })[1]).toBe("paused");
    expect(describeRobot({ ...own, holdReason: "", limits: ["joint4"] })[1]).toBe("joint 4 at its end");
  });

  test("a robot whose holder has to consent, and one that one waits for", () => {
    const asked = { ...lease, mode: "request" } as Lease;
    expect(describeRobot({ ...facts, lease: asked, isPointedAt: true })).toEqual(["left: ben", "press the trigger to ask for it"]);
    expect(describeRobot({ ...facts, lease: asked, isPointedAt: true, isRequested: true })).toEqual(["left: ben", "waiting for ben's consent"]);
    expect(describeRobot({ ...facts, lease, isRequested: true })).toEqual(["left: ben"]); // a reply comes at once
    expect(describeRobot({ ...facts, lease: { ...lease, queue: ["p3", "p1"] } })).toEqual(["left: ben", "you wait for it, place 2 of 2"]);
    expect(describeConsent("ben", "left", 14_200)).toEqual(["ben asks you for left", "point at an answer, press the trigger: 15 s"]);
  });

  test("one's own alignment, with its stated error", () => {
    const alignment = { kind: "measured", error_at_robot_m: 0.0042, offset: false } as NonNullable<ParticipantInfo["alignment"]>;
    expect(describeAlignment(alignment)).toBe("aligned ± 4.2 mm at the robot");
    expect(describeAlignment({ ...alignment, offset: true })).toBe("aligned, with an offset by hand");
    expect(describeAlignment({ ...alignment, kind: "placed" })).toMatch(/director/);
    expect(describeAlignment({ ...alignment, kind: "fingertip" })).toBe("to look, not to drive ± 4.2 mm at the robot");
    expect(isPlaced({ ...alignment, kind: "persistent" })).toBe(true);
    expect(isPlaced({ ...alignment, kind: "none" })).toBe(false);
    expect(describeAlignment({ ...alignment, kind: "not_needed" })).toBe("not aligned");
    expect(describeAlignment(null)).toBe("not aligned");
  });

  test("before the eyes: nothing while all is well, else what matters most first", () => {
    const well = { isStopped: false, pause: "", connection: "", isAligned: true, isTransparent: true, canPlace: false, hasMarks: false, doubt: "", advice: "", notice: "" };
    expect(describeUrgent(well)).toEqual([]);
    const old = { ...well, doubt: "the alignment is 6 min old" };
    expect(describeUrgent(old).join(" ")).toMatch(/^The alignment is 6 min old: .*director/);
    expect(describeUrgent({ ...old, hasMarks: true }).join(" ")).toMatch(/Touch marks/);
    expect(describeUrgent({ ...old, isAligned: false })).toEqual(describeUrgent({ ...well, isAligned: false }));
    expect(describeUrgent({ ...well, isAligned: false }).join(" ")).toMatch(/not aligned The scene appears when/);
    expect(describeUrgent({ ...well, isAligned: false, hasMarks: true }).join(" ")).toMatch(/hold a trigger for two seconds/);
    expect(describeUrgent({ ...well, isAligned: false, isTransparent: false }).join(" ")).toMatch(/a place of this headset's own/);
    expect(describeUrgent({ ...well, isAligned: false, isTransparent: false, canPlace: true }).join(" ")).toMatch(/To stay here: point at no robot/);
    expect(describeUrgent({ ...well, pause: "Paused by ann" })[0]).toBe("Paused by ann");
    expect(describeUrgent({ ...well, isStopped: true, connection: "lost", isAligned: false })).toEqual(["STOPPED: all robots hold", "lost"]);
  });

  test("at a hand: nothing while it works, else what the person does", () => {
    expect(describeHand(false, null)).toEqual([]);
    expect(describeHand(true, "squeeze").join(" ")).toMatch(/out of sight/);
    expect([describeHand(false, "squeeze"), describeHand(false, "trigger")]).toEqual([["let go, then squeeze again"], ["let go, then press again"]]);
  });

  test("long texts are wrapped between words", () => {
    const text = "a robot that is held by another participant is not moved by this headset";
    expect(wrap(text).join(" ")).toBe(text);
    expect(Math.max(...wrap(text).map((line) => line.length))).toBeLessThanOrEqual(44);
  });

  test("why there is no headset", () => {
    expect(describeMissing(false, true)).toMatch(/HTTPS/);
    expect(describeMissing(true, false)).toMatch(/no WebXR/);
    expect(describeMissing(true, true)).toBe("");
  });
});

describe("haptics", () => {
  const quiet = { type: "feedback" as const, robot: "left", state: "pose", hold_reason: "", contact_n: 0, limits: [], rejected: {} };

  test("contact, a refused motion and a limit are felt; an open clutch is not", () => {
    expect(findPulse(quiet, quiet)).toBeNull();
    expect(findPulse(quiet, { ...quiet, contact_n: 5 })?.intensity).toBeCloseTo(0.45);
    expect(findPulse({ ...quiet, contact_n: 5 }, { ...quiet, contact_n: 4 })).toBeNull();
    expect(findPulse(quiet, { ...quiet, hold_reason: "untracked" })?.duration_ms).toBe(150);
    expect(findPulse(quiet, { ...quiet, hold_reason: "clutch_open" })).toBeNull();
    expect(findPulse(quiet, { ...quiet, limits: ["elbow"] })).not.toBeNull();
    expect(findPulse({ ...quiet, limits: ["elbow"] }, { ...quiet, limits: ["elbow"] })).toBeNull();
  });
});
