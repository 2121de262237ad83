// What the list says of a robot, and what it offers: as things are now, and nothing that the session would refuse.

import { afterEach, beforeEach, expect, test, vi } from "vitest";

import type { FromWorker, Lease } from "../../src/core/api.ts";
import { WorkerClient, type WorkerPort } from "../../src/core/page_client.ts";
import { findOffer } from "../../src/ui/robot_controls.ts";
import { describe as describeRow } from "../../src/ui/robots.ts";
import { PageState } from "../../src/ui/state.ts";

const port: WorkerPort = { postMessage: () => undefined, onmessage: null };
const say = (update: object): unknown => port.onmessage?.({ data: update as FromWorker } as MessageEvent<FromWorker>);
const RELEASED = { robot: "", isHeldBack: false };
const READY = "ready: drag the arrows at its gripper";

let state: PageState;
const describe = (drive = RELEASED): string => describeRow(state, drive, "left");

/** The session with these leases; ann (p1) looks, ben (p2) is a person, arm (p3) an agent. */
function saySession(leases: Partial<Lease>[], changed: object = {}): void {
  const participants = [["p1", "ann", "director"], ["p2", "ben", "operator"], ["p3", "arm", "agent"]].map(([id, name, role]) => ({ id, name, role }));
  const filled = leases.map((lease) => ({ kind: "robot", mode: "exclusive", holder: "", sub_holders: [], queue: [], expires_ns: 0, ...lease }));
  say({ type: "session", participant_id: "p1", participants, leases: filled, robots: [{ name: "left" }, { name: "right" }], paused: false, estop: false, ...changed });
}
const sayReport = (holder: string, hold_reason: string, moves = "hold"): unknown =>
  say({ type: "status", status: { robots: [{ name: "left", holder, hold_reason, state: moves }], media: [] } });
const sayFeedback = (hold_reason: string): unknown =>
  say({ type: "inbox", messages: [{ type: "feedback", robot: "left", state: hold_reason ? "hold" : "twist", hold_reason, limits: [] }] });

beforeEach(() => {
  vi.stubGlobal("requestAnimationFrame", () => 0);
  state = new PageState(new WorkerClient(port));
  say({ type: "phase", phase: "ready" });
});
afterEach(() => vi.unstubAllGlobals());

test("a robot that was just taken is ready, and one that was just released is free, whatever the report of before says", () => {
  sayReport("", "no_lease");
  saySession([{ target: "left", holder: "p1" }]);
  expect(describe()).toBe(READY);
  sayReport("p1", "", "twist");
  saySession([{ target: "left" }]);
  expect(describe()).toBe("");
  sayReport("", "", "pose");
  expect(describe()).toBe("goes to its home");
});

test("a stop that was cleared is no reason any more, and what has to be let go is said only while it is pressed", () => {
  const own = [{ target: "left", holder: "p1" }];
  sayFeedback("estop");
  saySession(own, { estop: true });
  expect(describe()).toBe("stopped");
  saySession(own);
  expect([describe(), describe({ robot: "left", isHeldBack: true })]).toEqual([READY, "holds: let go, then hold again"]);
  for (const reason of ["gap", "rearm", "stale", "no_lease", "clutch_open"]) {
    sayFeedback(reason);
    expect(describe()).toBe(READY);
  }
  sayFeedback("untracked");
  expect(describe()).toBe("holds: tracking lost");
  sayFeedback("");
  expect(describe()).toBe("driven");
});

test("of a robot that another one holds the report counts, not what was fed back before", () => {
  sayFeedback("clutch_open");
  saySession([{ target: "left", holder: "p2" }]);
  sayReport("p2", "", "twist");
  expect(describe()).toBe("driven");
  sayReport("p2", "estop");
  expect(describe()).toBe("holds: it waits for its operator");
  sayReport("p3", "gap");
  expect(describe()).toBe("");
});

test.each([
  ["exclusive", "p2", { take: "", waits: true, none: "" }],
  ["request", "p2", { take: "Ask for it", waits: false, none: "" }],
  ["takeover", "p2", { take: "Take over", waits: false, none: "" }],
  ["shared", "p2", { take: "Take", waits: true, none: "" }],
  ["priority", "p2", { take: "", waits: true, none: "" }],
  ["priority", "p3", { take: "Take", waits: false, none: "" }],
  ["exclusive", "", { take: "Take", waits: false, none: "" }],
  ["exclusive", "p1", { take: "", waits: false, none: "" }],
])("in mode %s a robot of %s is offered as the session grants it", (mode, holder, offer) => {
  saySession([{ target: "left", mode, holder }]);
  expect(findOffer(state, "left")).toEqual(offer);
});

test("a holder of a robot, or of a place in a queue, cannot wait for another robot, and the panel says why", () => {
  saySession([{ target: "left", holder: "p2" }, { target: "right", holder: "p1" }]);
  expect(findOffer(state, "left")).toEqual({ take: "", waits: false, none: "Release right to wait for it." });
  saySession([{ target: "left", holder: "p2" }, { target: "right", holder: "p3", queue: ["p1"] }]);
  expect(["left", "right"].map((robot) => findOffer(state, robot))).toEqual([
    { take: "", waits: false, none: "You wait for right." },
    { take: "", waits: false, none: "You wait for it." },
  ]);
});

test("a holder in another tab of this browser is named as that, in this session", () => {
  const stored: Record<string, string> = {};
  vi.stubGlobal("localStorage", { getItem: (key: string) => stored[key] ?? null, setItem: (key: string, value: string) => (stored[key] = value) });
  const join = (session_id: string, participant_id: string): void => {
    state = new PageState(new WorkerClient(port));
    say({ type: "welcome", welcome: { session_id, participant_id } });
    saySession([]);
  };
  join("a", "p2");
  join("a", "p1");
  expect([state.holderName("p2"), state.holderName("p3")]).toEqual(["ben, your other tab", "arm"]);
  join("b", "p1");
  expect(state.holderName("p2")).toBe("ben");
});
