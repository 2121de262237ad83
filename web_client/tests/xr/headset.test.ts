// An immersive session whose headset, picture and session are those of the test: what is asked of the session, and when.

import { Group } from "three";
import { afterEach, beforeEach, expect, test, vi } from "vitest";

import type { AnchorPlace, ToWorker } from "../../src/core/api.ts";
import type { WorkerClient } from "../../src/core/page_client.ts";
import type { Actions } from "../../src/ui/actions.ts";
import { DESKTOP, PageState } from "../../src/ui/state.ts";
import { StreamChoices } from "../../src/ui/stream_choices.ts";
import type { View } from "../../src/view/view.ts";
import type { ConsentPanel } from "../../src/xr/consents.ts";
import type { Hands } from "../../src/xr/hands.ts";
import { Headset, type Mode } from "../../src/xr/headset.ts";
import type { Marks } from "../../src/xr/marks.ts";
import { STOP_BUTTONS } from "../../src/xr/reading.ts";

const POSE = { transform: { position: { x: 0, y: 1, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } }, emulatedPosition: false };
const LEASE = { target: "arm", kind: "robot", holder: "p1", sub_holders: [], mode: "exclusive", queue: [], lease_version: 1 };

/** A WebXR session with one controller. */
class Session extends EventTarget {
  visibilityState = "visible";
  buttons = [0, 1, 2, 3].map(() => ({ value: 0, pressed: false }));
  inputSources = [{ handedness: "right", targetRaySpace: "aim", gripSpace: "grip", gamepad: { buttons: this.buttons } }];

  show(state: string): void {
    this.visibilityState = state;
    this.dispatchEvent(new Event("visibilitychange"));
  }
}

let session: Session;
let state: PageState;
let posted: ToWorker[];
let requests: { type: string }[];
let stops: number;
let isGranted: boolean;
let headset: Headset;
let enter: (mode: Mode) => Headset;
let takeInbox: (update: unknown) => void;
afterEach(() => void vi.useRealTimers());
beforeEach(() => {
  vi.useFakeTimers({ toFake: ["performance"] });
  vi.stubGlobal("document", { createElement: () => ({ getContext: () => null }) });
  [session, posted, requests, stops, isGranted] = [new Session(), [], [], 0, true];
  const on = (type: string, listener: typeof takeInbox): (() => void) => {
    if (type === "inbox") takeInbox = listener;
    return () => undefined;
  };
  const client = { on, post: (message: ToWorker) => posted.push(message) } as unknown as WorkerClient;
  state = new PageState(client);
  state.phase = { ...state.phase, phase: "ready" };
  state.spec = { environment: { center: [0, 0, 0], extent: 1 }, bodies: [] } as unknown as PageState["spec"];
  setSession({ role: "director" });
  const actions = {
    request: async (message: { type: string }) => {
      requests.push(message);
      return isGranted;
    },
    estop: () => (stops += 1),
  } as unknown as Actions;
  const view = { viewpoint: { axes: { forward: [1, 0, 0] } }, scene: { bodies: new Map([[1, new Group()]]) } } as unknown as View;
  enter = (mode) => new Headset(session as unknown as XRSession, mode, view, state, client, new StreamChoices(() => [], () => true), actions);
  headset = enter("immersive-vr");
});

function setSession(self: object, robots: readonly string[] = [], holder = "p1"): void {
  const participant = { id: "p1", name: "ann", role: "director", devices: ["head"], alignment: null, ...self };
  const leases = robots.map((target) => ({ ...LEASE, target, holder }));
  const listed = robots.map((name) => ({ name, site_body: 1, base_body: 1 }));
  state.session = { participant_id: "p1", participants: [participant], leases, robots: listed, anchors: [], estop: false } as unknown as PageState["session"];
}

const frame = { getViewerPose: () => POSE, getPose: () => POSE } as unknown as XRFrame;

/** After 100 ms, show a frame with buttons of the controller, and return its sample. */
function show(trigger = 0, squeeze = 0): { clutch?: boolean; tracked?: boolean; gripper?: number | null } {
  vi.advanceTimersByTime(100);
  session.buttons[0]!.value = trigger;
  session.buttons[1]!.value = squeeze;
  headset.onFrame(frame, {} as XRReferenceSpace);
  return lastSample();
}

function lastSample(): { clutch?: boolean; tracked?: boolean; gripper?: number | null } {
  const last = posted.findLast((message) => message.type === "samples");
  return last!.samples.find(({ device }) => device === "controller/right")!;
}

test("a page that joins again while it is a headset says so, and one that has left it says that it has a screen", () => {
  expect(state.entry.devices).toContain("head");
  expect(posted.at(-1)).toEqual({ type: "rejoin", ...state.entry });
  headset.dispose();
  expect(state.entry).toEqual(DESKTOP);
});

test("a squeeze that is held while a menu comes and goes, without a frame meanwhile, counts from its next press", () => {
  setSession({}, ["arm"]);
  const clutch = (squeeze: number): boolean | undefined => show(0, squeeze).clutch;
  expect([0, 1, 1].map(clutch)).toEqual([false, false, true]);
  session.show("hidden");
  expect(lastSample()).toMatchObject({ clutch: false, tracked: false });
  session.show("visible");
  expect([1, 1, 0, 1].map(clutch)).toEqual([false, false, false, true]);
});

test("a director in VR is placed when it asks for that, as often as it is not aligned, and an operator is not", () => {
  const tap = (): void => {
    for (const trigger of [0, 1, 0]) show(trigger);
  };
  show();
  expect(headset.showsScene).toBe(true);
  expect(requests).toEqual([]);
  tap();
  expect(requests).toMatchObject([{ type: "place_alignment", participant: "p1" }]);
  setSession({ alignment: { kind: "placed", T_world_tracking: [[0, 0, 0], [1, 0, 0, 0]] } });
  tap();
  expect(requests.length).toBe(1);
  setSession({ alignment: null }); // the headset has recentred
  show();
  expect(requests.length).toBe(1);
  tap();
  expect(requests.length).toBe(2);
  setSession({ role: "operator" });
  tap();
  expect(requests.length).toBe(2);
});

test("a recentre leaves the scene without a place until it is aligned to the new tracking frame, also without a connection", () => {
  const align = (version: number, tracking_epoch: number): boolean => {
    setSession({ alignment: { version, kind: "measured", tracking_epoch, T_world_tracking: [[0, 0, 0], [1, 0, 0, 0]] } });
    show();
    return headset.showsScene;
  };
  headset = enter("immersive-ar");
  expect(align(3, 0)).toBe(true);
  state.phase = { ...state.phase, phase: "waiting" };
  headset.onReset();
  expect(posted.at(-1)).toEqual({ type: "tracking_jump" });
  show();
  expect(headset.showsScene).toBe(false);
  expect(align(4, 0)).toBe(false); // it was on its way
  expect(align(5, 1)).toBe(true);
});

test("a button of the e-stop stops, whatever the controller's pose is", () => {
  show();
  session.buttons.forEach((button, i) => (button.pressed = ((STOP_BUTTONS >> i) & 1) === 1));
  headset.onFrame({ ...frame, getPose: () => null } as unknown as XRFrame, {} as XRReferenceSpace);
  expect(stops).toBe(1);
});

test("a button of the e-stop that is held when a menu goes counts again, and one of a frame that fails counts", () => {
  const press = (isPressed: boolean): void => void (session.buttons[3]!.pressed = isPressed);
  const { consent } = headset as unknown as { consent: ConsentPanel };
  show();
  press(true);
  show();
  show();
  expect(stops).toBe(1);
  session.show("visible-blurred");
  show();
  expect(stops).toBe(1);
  session.show("visible");
  show();
  expect(stops).toBe(2);
  press(false);
  show();
  press(true);
  vi.spyOn(consent, "update").mockImplementation(() => {
    throw new Error("a question that cannot be drawn");
  });
  expect(() => show()).toThrow();
  expect(stops).toBe(3);
});

test("a gripper that was opened stays as it is after another lease or a reset, and while the robot is shared", () => {
  const grip = (squeeze: number, trigger: number): number | null | undefined => show(trigger, squeeze).gripper;
  const change = (lease: object, scene_epoch = 1): void => {
    setSession({}, ["arm"]);
    Object.assign(state.session!.leases[0]!, lease);
    Object.assign(state.session!, { scene_epoch });
  };
  state.feedback.set("arm", { hold_reason: "", contact_n: 0, limits: [] } as unknown as NonNullable<ReturnType<PageState["feedback"]["get"]>>);
  for (const [lease, scene_epoch] of [[{ lease_version: 2 }, 1], [{}, 2], [{ sub_holders: ["p1", "p2"] }, 1]] as const) {
    change({});
    grip(0, 0);
    for (let i = 0; i < 3; i++) grip(1, 1);
    for (let i = 0; i < 15; i++) grip(1, 0);
    expect([grip(0, 0), grip(1, 0), grip(1, 0)]).toEqual([null, 0, 0]); // only this person may have moved it
    grip(0, 0);
    change(lease, scene_epoch);
    expect([grip(0, 0), grip(1, 0), grip(1, 0)]).toEqual([null, null, null]);
  }
});

test("a trigger that is held on a mark gives no answer when its ray crosses one, and a press at it does", () => {
  const { consent, marks } = headset as unknown as { consent: ConsentPanel; marks: Marks };
  const answer = vi.spyOn(consent, "answer").mockImplementation(() => undefined);
  const aim = vi.spyOn(consent, "update").mockReturnValue([]);
  const places = ["1", "2", "3"].map((id, i) => ({ id, p_anchor: [0.1 * i, 0.1 * (i % 2), 0] }));
  setSession({});
  state.session!.anchors = [{ anchor_id: "table", T_world_anchor: [[0, 0, 0], [1, 0, 0, 0]], size_m: 0, error_m: 0, marks: places }] as unknown as AnchorPlace[];
  marks.touching.tips.set("controller/right", { p: [0, 0, 0], covariance: [], error_m: 0 });
  show();
  marks.touching.begin();
  for (const trigger of [0, 0, 1, 0, 1, 1]) show(trigger);
  expect([marks.isActive, requests]).toEqual([true, []]); // a short press is no wish to be placed
  aim.mockReturnValue([{ side: "right", target: "grant", distance: 1 }]);
  for (const trigger of [1, 1, 0]) show(trigger);
  expect(answer).not.toHaveBeenCalled();
  show(1);
  expect(answer).toHaveBeenCalledWith("grant");
});

test("a robot that was denied does not come to the hand when it is assigned later", async () => {
  const { hands } = headset as unknown as { hands: Hands };
  const press = async (): Promise<void> => {
    show();
    setSession({}, ["arm"], "p2");
    show();
    show(1);
    await Promise.resolve(); // the reply
    show();
  };
  isGranted = false;
  await press();
  expect(requests).toMatchObject([{ type: "acquire", robots: ["arm"] }]);
  setSession({}, ["arm"]);
  show();
  expect(hands.driven.size).toBe(0);
  isGranted = true;
  await press();
  setSession({}, ["arm"]);
  show();
  expect(hands.driven.get("right")).toBe("arm");
});

test("why a press of the wearer's button did nothing is before its eyes, and not that of others", () => {
  const shown = vi.spyOn(headset, "show");
  const notice = (participant: string, reason: string): object => ({ type: "event", body: { event: "notice", level: "warning", text: reason, participant, reason } });
  takeInbox({ type: "inbox", messages: [notice("p1", "not_holder"), notice("p2", "held"), notice("p1", "alignment_refused"), notice("p1", "")] });
  expect(shown.mock.calls).toEqual([["not_holder"]]);
});
