// What this person may do with one robot: take, wait, drive, release, assign. For the list and for the menu in the picture.

import type { Target } from "../protocol/messages.g.ts";
import type { Drive } from "../desktop/drive.ts";
import type { Actions } from "./actions.ts";
import { button, h, setLabel, setOptions, setText, setValue } from "./dom.ts";
import type { PageState } from "./state.ts";

const FREE = "";
/** The last sample arrives before the robot is released: the session may take a request first [ms]. */
const LAST_SAMPLE_MS = 50;
/** Roles that drive robots. */
const DRIVERS = ["operator", "agent", "leader", "director"];

export interface RobotControls {
  /** Take, wait, drive, release. */
  buttons: HTMLButtonElement[];
  /** The choice of a holder, for directors. */
  assign: HTMLElement;
  update(): void;
}

/**
 * What this person may ask for. `take`: words of the button for a request that is granted at once, or by the holder;
 * empty where it would be refused. `waits`: a place in the queue may be asked for. `none`: why there is neither.
 */
export interface Offer {
  take: string;
  waits: boolean;
  none: string;
}

/** Return what the session would not refuse: by role, lease mode, and what this person holds or waits for. */
export function findOffer(state: PageState, robot: string): Offer {
  const lease = state.lease(robot);
  const mine = state.heldBy(state.selfId);
  if (!DRIVERS.includes(state.role)) return { take: "", waits: false, none: "Your role does not drive robots." };
  if (!state.isReady || mine.includes(robot)) return { take: "", waits: false, none: "" };
  if (!lease?.holder) return { take: "Take", waits: false, none: "" };
  const words: Record<string, string> = { takeover: "Take over", request: "Ask for it", shared: "Take" };
  const isAgentAlone = state.participant(lease.holder)?.role === "agent" && lease.sub_holders.length <= 1;
  const take = words[lease.mode] ?? (lease.mode === "priority" && isAgentAlone ? "Take" : ""); // people come before agents
  const queue = state.session?.leases.find((one) => one.queue.includes(state.selfId));
  const none = mine.length > 0 ? `Release ${mine.join(", ")} to wait for it.` : queue ? `You wait for ${queue.target === robot ? "it" : queue.target}.` : "";
  return { take, waits: none === "" && (take === "" || lease.mode === "shared"), none };
}

/** Make the controls of a robot. `name` gives its name: it may change. */
export function makeRobotControls(robot: () => string, state: PageState, actions: Actions, drive: Drive): RobotControls {
  const acquire = (wait: boolean): void =>
    void actions.request({ type: "acquire", robots: [robot()], wait }, `${robot()} is yours${state.followsPoses(robot()) ? ": drag its arrows" : ""}.`);
  const take = button("Take", () => acquire(false), { class: "small primary" });
  const wait = button("Wait for it", () => acquire(true), { class: "small" });
  const steer = button("Drive", () => drive.toggle(robot()), { class: "small primary" });
  const release = button(
    "Release",
    () => {
      const lease = state.lease(robot());
      if (!lease) return;
      const isDriven = drive.robot === robot();
      if (isDriven) drive.toggle(robot());
      const target: Target = [robot(), lease.lease_version, "robot"];
      setTimeout(() => actions.release([target]), isDriven ? LAST_SAMPLE_MS : 0);
    },
    { class: "small" },
  );
  const select = h("select", { class: "small" });
  select.addEventListener("change", () => {
    const [name, participant] = [robot(), select.value];
    const done = participant === FREE ? `The robot ${name} is free.` : `${state.nameOf(participant)} has the robot ${name}.`;
    void actions.request({ type: "assign", robots: [name], participant }, done).then((granted) => {
      if (!granted) select.value = state.lease(name)?.holder ?? FREE;
    });
  });
  const assign = h("label", { class: "field" }, h("span", {}, "Assign"), select);
  return {
    buttons: [take, wait, steer, release],
    assign,
    update: () => {
      const name = robot();
      const lease = state.lease(name);
      const isMine = state.heldBy(state.selfId).includes(name);
      const offer = findOffer(state, name);
      take.hidden = offer.take === "";
      setText(take, offer.take || "Take");
      wait.hidden = !offer.waits;
      wait.classList.toggle("primary", take.hidden);
      steer.hidden = !isMine || !state.isReady || !state.followsPoses(name);
      setText(steer, drive.robot === name ? "Stop driving" : "Drive");
      release.hidden = !isMine || !state.isReady;
      for (const one of [take, wait, steer, release]) setLabel(one, `${one.textContent ?? ""}: ${name}`);
      assign.hidden = !state.isDirector || !state.isReady;
      setLabel(select, `Assign ${name} to`);
      const drivers = (state.session?.participants ?? []).filter((one) => DRIVERS.includes(one.role) || one.id === lease?.holder);
      setOptions(select, [[FREE, "free"], ...drivers.map((one) => [one.id, state.nameOf(one.id)] as const)]);
      setValue(select, lease?.holder ?? FREE);
    },
  };
}
