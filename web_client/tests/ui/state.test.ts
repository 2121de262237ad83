// What the page knows of its streams: ages, and whether it shows the session's newest frame.

import { afterEach, beforeEach, expect, test, vi } from "vitest";

import { type FromWorker, nowMs } from "../../src/core/api.ts";
import { WorkerClient, type WorkerPort } from "../../src/core/page_client.ts";
import { PageState } from "../../src/ui/state.ts";

const port: WorkerPort = { postMessage: () => undefined, onmessage: null };
const say = (update: object): unknown => port.onmessage?.({ data: update as FromWorker } as MessageEvent<FromWorker>);
const sayFrame = (received_ms: number): unknown => say({ type: "cloud", stream: "room", cloud: {}, capture_ms: received_ms - 50, received_ms });
/** Report at `session_ms` that the newest frame of the session is `age_ms` old. */
const sayStatus = (session_ms: number, age_ms: number, hz = 0): unknown =>
  say({ type: "status", status: { session_time: 1e6 * session_ms, media: [{ stream: "room", age_ms, hz }] } });

let state: PageState;

beforeEach(() => {
  vi.stubGlobal("requestAnimationFrame", () => 0);
  state = new PageState(new WorkerClient(port));
});
afterEach(() => vi.unstubAllGlobals());

test("a page is behind when the session has had a newer frame for more than two seconds", () => {
  sayStatus(10_000, 0);
  expect(state.isBehind("room")).toBe(false); // it has no frame
  sayFrame(10_000);
  sayStatus(11_900, 0);
  expect(state.isBehind("room")).toBe(false);
  sayStatus(12_100, 0);
  expect(state.isBehind("room")).toBe(true);
  sayFrame(12_100);
  expect(state.isBehind("room")).toBe(false);
});

test("a page that gets few frames is behind when more than these are missing", () => {
  sayFrame(10_000);
  const isBehindAfter = (ms: number, budget_class: string): boolean => {
    say({ type: "budget", budget: { streams: [{ stream: "room", budget_class }] } });
    sayStatus(10_000 + ms, 0, 10);
    return state.isBehind("room");
  };
  expect(isBehindAfter(5100, "quarter")).toBe(false); // every 32nd of 10 frames a second
  expect(isBehindAfter(5300, "quarter")).toBe(true);
  expect(isBehindAfter(2100, "half")).toBe(false);
  expect(isBehindAfter(2300, "half")).toBe(true);
  for (const budgetClass of ["full", "none"]) expect(isBehindAfter(2100, budgetClass)).toBe(true);
});

test("a cloud at rest is not behind, however old it is, and neither is a session that does not tell", () => {
  sayFrame(10_000);
  sayStatus(70_000, 60_000);
  expect(state.isBehind("room")).toBe(false);
  sayFrame(0);
  sayStatus(70_000, 0);
  expect(state.isBehind("room")).toBe(false);
});

test("a frame has an age until its stream is forgotten", () => {
  say({ type: "clock", session_offset_ms: 1000 - nowMs(), error_ms: 1, rtt_ms: 1, settled: true });
  sayFrame(950);
  expect(state.ageOf("room")).toBeGreaterThanOrEqual(100);
  expect(state.ageOf("room")).toBeLessThan(1000);
  state.forgetFrames((stream) => stream === "room");
  expect(state.ageOf("room")).toBeUndefined();
  sayFrame(950);
  say({ type: "budget", budget: { streams: [] } });
  expect(state.ageOf("room")).toBeUndefined();
});

test("what belongs to a session is gone when another one begins, not when the same one welcomes again", () => {
  const sayWelcome = (session_id: string): unknown => say({ type: "welcome", welcome: { session_id, session_name: `scene ${session_id}` } });
  sayWelcome("a");
  say({ type: "session", participants: [{ id: "p1", name: "ann" }], paused: false, episode: { number: 3 } });
  say({ type: "stats", state_hz: 60 });
  sayStatus(10_000, 0);
  sayFrame(10_000);
  state.note("old");
  sayWelcome("a");
  expect([state.log.length, state.session?.episode?.number, state.status?.media.length, state.nameOf("p1")]).toEqual([1, 3, 1, "ann"]);
  sayWelcome("b");
  expect(state.welcome?.session_name).toBe("scene b");
  expect([state.log.length, state.session, state.status, state.stats, state.ageOf("room"), state.nameOf("p1")]).toEqual([0, null, null, null, undefined, "p1"]);
});

test("rejected samples of one participant and kind are one line that counts up where it is", () => {
  const sayRejected = (participant: string, count: number): unknown =>
    say({ type: "inbox", messages: [{ type: "event", session_time: 65e9, body: { event: "samples_rejected", participant, device: "desktop", reason: "stale", count } }] });
  for (const count of [3, 300, 622]) {
    sayRejected("p1", count);
    sayRejected("p2", 1);
    state.note("between");
  }
  expect(state.log.map(({ count }) => count)).toEqual([0, 0, 0, 1, 622]);
  expect(state.log.at(-1)!.text).toBe("622 samples of p1 (desktop) rejected: stale, last at 1:05.0");
});

test("a session that stands still again and again is one line with a count", () => {
  const sayMessages = (...messages: object[]): unknown => say({ type: "inbox", messages });
  for (let i = 0; i < 3; i++) {
    sayMessages({ type: "protocol_fault", code: "stalled", message: "the session does not step: robots hold" });
    sayMessages({ type: "event", session_time: 1e9 * i, body: { event: "gap", kind: "stalled", duration_ns: 4e8, rows: 0 } });
    sayMessages({ type: "event", session_time: 1e9 * i, body: { event: "marker_added", participant: "p1", text: "on" } });
    sayMessages({ type: "protocol_fault", code: "recovered", message: "the session steps again" });
  }
  expect(state.log.map(({ count }) => count)).toEqual([0, 0, 0, 3]);
  expect(state.log[3]!.text).toMatch(/steps again \(3 times\)/);
});

test("an alignment is void once the tracking frame has jumped, until the session has none or one to the new frame", () => {
  const align = (alignment: object | null): unknown => {
    say({ type: "session", participant_id: "p1", participants: [{ id: "p1", name: "ann", alignment }] });
    return state.alignment;
  };
  const old = { kind: "measured", version: 1, tracking_epoch: 0 };
  expect(align(old)).toEqual(old);
  state.voidAlignment();
  expect([align(old), align({ ...old, version: 2 })]).toEqual([null, null]);
  const next = { ...old, tracking_epoch: 1 };
  expect(align(next)).toEqual(next);
  state.voidAlignment();
  expect([align(next), align(null), align(old)]).toEqual([null, null, old]); // the last one is of another session
});

test("a pause says who and why, and who is not known to a page that joined later", () => {
  const saySession = (paused: boolean): unknown => say({ type: "session", participants: [{ id: "p2", name: "ben" }], paused });
  const sayPause = (body: object): unknown => say({ type: "inbox", messages: [{ type: "event", session_time: 0, body: { event: "pause_changed", paused: true, ...body } }] });
  saySession(false);
  expect(state.pause).toBeNull();
  sayPause({ participant: "p2", reason: "" });
  saySession(true);
  expect(state.pause).toEqual({ by: "ben", reason: "" });
  saySession(false);
  saySession(true);
  expect(state.pause).toEqual({ by: "", reason: "" });
  say({ type: "status", status: { paused_by: "ann", pause_reason: "", media: [] } });
  expect(state.pause).toEqual({ by: "ann", reason: "" });
  sayPause({ participant: "host", reason: "numbers that are not finite" });
  expect(state.pause).toEqual({ by: "the session", reason: "numbers that are not finite" });
});

test("a hand follows no poses, other robots do", () => {
  say({ type: "session", participants: [], leases: [], robots: [{ name: "arm", kind: "arm" }, { name: "fingers", kind: "hand" }] });
  expect(["arm", "fingers", "unknown"].map((robot) => state.followsPoses(robot))).toEqual([true, false, true]);
});
