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
let state: PageState;
let joining: Joining;

const remembered = (): unknown => JSON.parse(stored["iris-session.page"] ?? "{}");
const begin = (role: string, held: string[]): void => {
  const leases = held.map((target) => ({ target, kind: "robot", holder: "p1", sub_holders: [] }));
  state.phase = { ...state.phase, phase: "ready" };
  state.session = { participant_id: "p1", participants: [{ id: "p1", name: "Web 00", role }], leases } as unknown as PageState["session"];
};

beforeEach(() => {
  vi.stubGlobal("requestAnimationFrame", () => 0);
  [stored, posted, requests, isGranted] = [{}, [], [], true];
  vi.stubGlobal("localStorage", { getItem: (key: string) => stored[key] ?? null, setItem: (key: string, value: string) => (stored[key] = value) });
  const client = { on: () => () => undefined, post: (message: ToWorker) => posted.push(message) } as unknown as WorkerClient;
  state = new PageState(client);
  const request = async (message: object): Promise<boolean> => {
    requests.push(message);
    return isGranted;
  };
  joining = new Joining(client, state, { request }, "https://robot:7725");
});
afterEach(() => vi.unstubAllGlobals());

test("who gives a name keeps the robot, and the name is remembered", async () => {
  begin("director", ["left"]);
  expect([joining.isAsking, joining.describeAnswer("director")]).toEqual([true, "OK"]);
  joining.answer("ann", "director");
  await vi.waitFor(() => expect(posted).toEqual([{ type: "set_name", name: "ann", rejoins: false }]));
  expect(requests).toEqual([{ type: "rename", participant: "p1", name: "ann" }]);
  expect(remembered()).toMatchObject({ name: "ann", role: "", isAsked: true });
  expect(joining.isAsking).toBe(false);
});

test("who is no director says hello anew, as the same participant", async () => {
  begin("operator", ["left"]);
  joining.answer("ann", "operator");
  expect([posted, requests]).toEqual([[{ type: "set_name", name: "ann", rejoins: true }], []]);
  expect(remembered()).toMatchObject({ name: "ann" });
});

test("a name that is refused is not remembered, nor is one that the session has changed", async () => {
  begin("director", []);
  isGranted = false;
  await joining.rename("\u0007");
  await joining.rename("Web 00");
  expect(posted).toEqual([]);
  expect(remembered()).not.toMatchObject({ name: "Web 00" });
  expect(requests).toHaveLength(1);
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
