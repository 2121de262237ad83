// Names and roles of this browser: what changes them keeps robots where that is possible, and is remembered.

import { afterEach, beforeEach, expect, test, vi } from "vitest";

import type { ToWorker } from "../../src/core/api.ts";
import type { WorkerClient } from "../../src/core/page_client.ts";
import { Joining } from "../../src/ui/joining.ts";
import { PageState } from "../../src/ui/state.ts";

let stored: Record<string, string>;
let posted: ToWorker[];
let requests: object[];
let isGranted: boolean;
let listeners: ((update: object) => void)[];
let state: PageState;
let joining: Joining;

const remembered = (): unknown => JSON.parse(stored["iris-session.page"] ?? "{}");
const begin = (role: string, held: string[], name = "Web 00"): void => {
  const leases = held.map((target) => ({ target, kind: "robot", holder: "p1", sub_holders: [] }));
  state.phase = { ...state.phase, phase: "ready" };
  for (const listener of listeners) listener({ participant_id: "p1", participants: [{ id: "p1", name, role }], leases });
};

beforeEach(() => {
  vi.stubGlobal("requestAnimationFrame", () => 0);
  [stored, posted, requests, isGranted, listeners] = [{ "iris-session.page": JSON.stringify({ name: "Web 00" }) }, [], [], true, []];
  vi.stubGlobal("localStorage", { getItem: (key: string) => stored[key] ?? null, setItem: (key: string, value: string) => (stored[key] = value) });
  const on = (type: string, listener: (update: object) => void): unknown => type === "session" && listeners.push(listener);
  const client = { on, post: (message: ToWorker) => posted.push(message) } as unknown as WorkerClient;
  state = new PageState(client);
  const request = async (message: object): Promise<boolean> => {
    requests.push(message);
    return isGranted;
  };
  joining = new Joining(client, state, { request }, "https://robot:7725");
});
afterEach(() => vi.unstubAllGlobals());

test.each(["director", "operator", "observer"])("a %s who gives a name keeps the robot, and the name that the session lists is remembered", async (role) => {
  begin(role, ["left"]);
  expect([joining.isAsking, joining.describeAnswer(role)]).toEqual([true, "OK"]);
  joining.answer("ann", role);
  expect(requests).toEqual([{ type: "rename", participant: "p1", name: "ann" }]);
  await Promise.resolve();
  expect(posted).toEqual([]); // the session may give another one
  begin(role, ["left"], "ann-2");
  expect(posted).toEqual([{ type: "set_name", name: "ann-2" }]);
  expect(remembered()).toMatchObject({ name: "ann-2", role: "", isAsked: true });
  expect(joining.isAsking).toBe(false);
});

test("a name that the session lists before its reply is remembered, too; one of before another role is not", async () => {
  begin("operator", []);
  const renamed = joining.rename("ann");
  begin("operator", [], "ann");
  await renamed;
  expect(posted).toEqual([{ type: "set_name", name: "ann" }]);
  joining.answer("eva", "observer");
  begin("operator", [], "ann");
  expect([remembered(), posted.length]).toMatchObject([{ name: "eva" }, 3]);
});

test("a name that is refused is not remembered, nor is one that the session has changed", async () => {
  begin("director", []);
  isGranted = false;
  await joining.rename("\u0007");
  await joining.rename("Web 00");
  begin("director", [], "eva");
  expect([posted, remembered(), requests.length]).toMatchObject([[], { name: "Web 00" }, 1]);
});

test("another role says before that it releases robots, and joins anew", () => {
  begin("director", ["left", "right"]);
  expect(joining.describeAnswer("operator")).toBe("OK, releases left, right");
  joining.answer("ann", "operator");
  expect(posted).toMatchObject([{ type: "disconnect" }, { type: "connect", name: "ann", role: "operator" }]);
  expect(remembered()).toMatchObject({ name: "ann", role: "operator" });
  begin("director", []);
  expect(joining.describeAnswer("operator")).toBe("OK");
});

test("roles are tried until one is admitted, a chosen one first", () => {
  const roles = (): string[] => posted.flatMap((message) => (message.type === "connect" ? [message.role] : []));
  const warn = vi.fn();
  joining.joinPaired("ann", ["operator", "observer"]);
  expect([joining.tryNextRole(warn), joining.tryNextRole(warn), roles()]).toEqual([true, false, ["operator", "observer"]]);
  joining.answer("ann", "observer");
  posted = [];
  expect([joining.tryNextRole(warn), roles(), warn.mock.calls.length]).toEqual([true, ["operator"], 1]);
});
