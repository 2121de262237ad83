// An immersive session: reads frames, sends samples, asks for what the hands mean, and shows panels and props. Everything
// that it decides is in the pure files of this folder.

import { Group, Vector3 } from "three";

import { type FromWorker, nowMs, type RobotInfo, type SceneSpec } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { HoldReason } from "../protocol/messages.g.ts";
import type * as wire from "../protocol/messages.g.ts";
import type { Actions } from "../ui/actions.ts";
import { describeEpisode, isUrgent } from "../ui/episodes.ts";
import { DESKTOP, type Entry, type PageState } from "../ui/state.ts";
import { doubtWords, pauseWords } from "../ui/words.ts";
import type { Mode as PageMode, StreamChoices } from "../ui/stream_choices.ts";
import { participantColor } from "../view/avatars.ts";
import { Label } from "../view/labels.ts";
import type { View } from "../view/view.ts";
import { ConsentPanel } from "./consents.ts";
import { FrameReader } from "./frame_reader.ts";
import { type Context, Hands, type Intent, type Target } from "./hands.ts";
import { Marks } from "./marks.ts";
import { PicturePanels } from "./picture_panels.ts";
import { placeBeforeScene } from "./placement.ts";
import { type Chain, findPointed, listChains } from "./pointing.ts";
import { Props } from "./props.ts";
import { type FrameReading, type Side, toWorldRay, type Vec3 } from "./reading.ts";
import { WristStop } from "./stop.ts";
import { awaitsConsent, describeAlignment, describeHand, describeRobot, describeUrgent, drawBar, findPulse, isPlaced, wrap } from "./words.ts";

export type Mode = Exclude<PageMode, "screen">;

const ENTRY: Entry = { devices: ["head", "controller/left", "controller/right", "hand/left", "hand/right"], alignment: "measured" };
/** A robot's panel: its lower edge above the highest link [m]; height of its lines as a share of their distance: 2.6 degrees. */
const PANEL_ABOVE_M = 0.06;
const PANEL_LINE_SHARE = 0.045;
/** Time that a denial is shown [ms], and between two updates of the panels. */
const NOTICE_MS = 5000;
const PANEL_PERIOD_MS = 100;
const SIDES = ["left", "right"] as const;
const URGENT_COLOR = "#e0a33a";
const FREE_COLOR = "#8a93a3";

/** One immersive session, from its begin to its end. Also what `View` draws with. */
export class Headset {
  /** The scene is shown as soon as it has a place. */
  showsScene = false;
  readonly isTransparent: boolean;
  /** The newest reading; for tests. */
  reading: FrameReading | null = null;
  private readonly hands = new Hands();
  private readonly wristStop = new WristStop();
  private readonly props = new Props();
  private readonly marks: Marks;
  private readonly consent: ConsentPanel;
  private readonly pictures: PicturePanels;
  private readonly reader: FrameReader;
  /** Panels at robots, in the session's world. */
  readonly panels = new Group();
  private readonly labels = new Map<string, Label>();
  private readonly feedback = new Map<string, wire.Feedback>();
  private pointed: Context["pointed"] = {};
  private aimed: Context["aimed"] = {};
  /** Robots that were asked for, until there is a reply. */
  private readonly requested = new Set<string>();
  private chains: ReadonlyMap<string, Chain> = new Map();
  private chainsOf: readonly [readonly RobotInfo[], SceneSpec] | null = null;
  private defaultPlace: wire.Pose | null = null;
  private notice = { text: "", until_ms: 0 };
  private panels_ms = Number.NEGATIVE_INFINITY;
  private readonly endListening: () => void;

  constructor(
    readonly session: XRSession,
    mode: Mode,
    private readonly view: View,
    private readonly state: PageState,
    private readonly client: WorkerClient,
    choices: StreamChoices,
    private readonly actions: Actions,
  ) {
    this.isTransparent = mode === "immersive-ar";
    state.mode = mode;
    this.reader = new FrameReader(session);
    this.marks = new Marks(session, this.isTransparent, state, client, actions);
    this.rig.add(this.marks.group);
    this.consent = new ConsentPanel(state, actions);
    this.pictures = new PicturePanels(state, choices, client);
    this.rig.add(this.consent.group, this.pictures.group);
    this.endListening = client.on("inbox", (update) => this.takeInbox(update));
    session.addEventListener("visibilitychange", () => this.onVisibility());
    this.rejoin(ENTRY);
  }

  get rig(): Group {
    return this.props.rig;
  }

  get camera(): Props["camera"] {
    return this.props.camera;
  }

  /** Show a text before the eyes for a while. */
  show(text: string): void {
    this.notice = { text, until_ms: performance.now() + NOTICE_MS };
  }

  /** The tracking frame jumps: what was aligned to it is void. */
  onReset(): void {
    this.client.post({ type: "tracking_jump" });
    this.state.voidAlignment();
    this.marks.touching.reset();
  }

  /** Take a frame: before the scene is drawn. */
  onFrame(frame: XRFrame, space: XRReferenceSpace): void {
    const isVisible = this.session.visibilityState === "visible";
    const read = this.reader.read(frame, space);
    // What is covered has no input; its devices are reported where they were, as not tracked.
    const reading = isVisible ? read : { ...read, inputs: this.reading?.inputs ?? [] };
    this.reading = reading;
    if (isVisible) this.takeStops(reading);
    const T_world_tracking = this.findPlace();
    this.showsScene = T_world_tracking !== null;
    if (T_world_tracking !== null) this.props.place(T_world_tracking);
    const hits = this.point(reading, T_world_tracking);
    if (isVisible) this.takeHands(reading, frame, space);
    else this.suspend();
    const samples = this.hands.makeSamples(reading, isVisible);
    if (samples.length > 0) this.client.post({ type: "samples", samples });
    this.props.move(reading, hits, this.wristStop.center);
    const now = performance.now();
    if (now - this.panels_ms < PANEL_PERIOD_MS) return;
    this.panels_ms = now;
    this.updatePanels(reading);
  }

  /** End: the page is one with a screen again. */
  dispose(): void {
    this.endListening();
    this.marks.dispose();
    this.consent.dispose();
    this.pictures.dispose();
    this.props.dispose();
    for (const label of this.labels.values()) label.dispose();
    this.panels.removeFromParent();
    this.client.post({ type: "worn", worn: true });
    this.state.mode = "screen";
    this.rejoin(DESKTOP);
  }

  /** Say what this page is from now on, and whenever it joins again. */
  private rejoin(entry: Entry): void {
    this.state.entry = entry;
    this.client.post({ type: "rejoin", ...entry });
  }

  /** No frames come while the session is hidden: what was held is not tracked any more, at once. */
  private onVisibility(): void {
    const { visibilityState } = this.session;
    this.client.post({ type: "worn", worn: visibilityState !== "hidden" });
    if (visibilityState === "visible" || this.reading === null) return;
    this.suspend();
    this.client.post({ type: "samples", samples: this.hands.makeSamples(this.reading, false) });
  }

  private suspend(): void {
    this.hands.suspend();
    this.hands.takeStops([]); // one that is held when input comes back counts
    this.wristStop.suspend();
  }

  // --- place ----------------------------------------------------------------------------------------------------------

  private get isAligned(): boolean {
    return isPlaced(this.state.alignment);
  }

  /** Return `T_world_tracking`, null: the scene has no place. */
  private findPlace(): wire.Pose | null {
    const { state } = this;
    const { alignment } = state;
    if (alignment && this.isAligned) return alignment.T_world_tracking;
    if (this.isTransparent || !state.spec) return null;
    this.defaultPlace ??= placeBeforeScene(state.spec.environment, this.view.viewpoint.axes.forward);
    return this.defaultPlace;
  }

  /** In VR nothing of the room is seen, so a director may be aligned by its own word: at the place that is shown. */
  private get canPlace(): boolean {
    const { state } = this;
    const isJoined = state.isReady && (state.self?.devices.includes("head") ?? false);
    return isJoined && state.isDirector && !this.isTransparent && !this.isAligned;
  }

  // --- hands ----------------------------------------------------------------------------------------------------------

  private makeContext(): Context {
    const { state } = this;
    const robots = new Set(state.session?.robots.map(({ name }) => name));
    const held = state.heldBy(state.selfId).filter((name) => robots.has(name));
    const own = held.map((name) => state.lease(name)).filter((lease) => lease?.sub_holders.length === 0);
    return {
      held,
      tenures: new Map(own.map((lease) => [lease!.target, `${lease!.lease_version} ${state.session?.scene_epoch}`])),
      following: [...robots].filter((name) => state.feedback.get(name)?.hold_reason === ""),
      guessed: [...robots].filter((name) => state.feedback.get(name)?.hold_reason === HoldReason.EMULATED),
      pointed: this.pointed,
      aimed: this.aimed,
      canPlace: this.canPlace,
      isTouching: this.marks.isActive,
    };
  }

  /** Find the answers, items of the menu and robots that hands point at. Returns how far away they are [m]. */
  private point(reading: FrameReading, T_world_tracking: wire.Pose | null): Partial<Record<Side, number>> {
    this.pointed = {};
    this.aimed = {};
    const hits: Partial<Record<Side, number>> = {};
    const take = (aims: readonly { side: Side; target: Target; distance: number }[]): void => {
      for (const { side, target, distance } of aims) {
        if (this.hands.isSqueezing(side) || this.aimed[side]) continue;
        this.aimed[side] = target;
        hits[side] = distance;
      }
    };
    take(this.consent.update(reading, this.describeWaiting()));
    const aims = this.pictures.move(reading);
    if (!this.marks.isActive) take(aims);
    const { session, spec } = this.state;
    if (T_world_tracking === null || !session || !spec || this.marks.isActive) return hits;
    if (this.chainsOf?.[0] !== session.robots || this.chainsOf[1] !== spec) {
      this.chains = listChains(session.robots, spec.bodies);
      this.chainsOf = [session.robots, spec];
    }
    for (const { side, ray, tracked } of reading.inputs) {
      if (!ray || !tracked || this.hands.isSqueezing(side) || this.aimed[side]) continue;
      const hit = findPointed(toWorldRay(T_world_tracking, ray), this.chains, (body) => this.positionOf(body));
      if (!hit) continue;
      this.pointed[side] = hit.robot;
      hits[side] = hit.distance;
    }
    return hits;
  }

  private positionOf(body: number): Vec3 | null {
    return this.view.scene?.bodies.get(body)?.position.toArray() ?? null;
  }

  private takeStops(reading: FrameReading): void {
    if (this.hands.takeStops(reading.stops)) this.actions.estop("button of a controller");
    if (this.wristStop.update(reading)) this.actions.estop("fingertip at the wrist");
  }

  /** Hands move no robot while they touch marks, and what they hold then counts afterwards from its next press. */
  private takeHands(reading: FrameReading, frame: XRFrame, space: XRReferenceSpace): void {
    const busy = Object.keys({ ...this.pointed, ...this.aimed }) as Side[];
    const wasActive = this.marks.isActive;
    this.marks.onFrame(frame, space, reading, busy);
    if (wasActive !== this.marks.isActive) this.hands.suspend();
    this.ask(this.hands.update(this.marks.mask(reading), this.makeContext()));
  }

  private ask(intents: readonly Intent[]): void {
    for (const intent of intents) {
      if (intent.type === "press") this.press(intent.target);
      else if (intent.type === "acquire") void this.acquire(intent.robot);
      else if (intent.type === "place") this.placeSelf();
      else {
        const lease = this.state.lease(intent.robot);
        if (lease) this.actions.release([[intent.robot, lease.lease_version, "robot"]]);
      }
    }
  }

  private press(target: Target): void {
    if (target === "grant" || target === "refuse") this.consent.answer(target);
    else this.pictures.press(target);
  }

  private placeSelf(): void {
    const T_world_tracking = this.findPlace();
    if (T_world_tracking) void this.actions.request({ type: "place_alignment", participant: this.state.selfId, T_world_tracking });
  }

  private async acquire(robot: string): Promise<void> {
    this.requested.add(robot);
    const isGranted = await this.actions.request({ type: "acquire", robots: [robot] });
    this.requested.delete(robot);
    this.hands.settle(robot, isGranted, nowMs());
  }

  /** Return whose consent this person waits for, as a line; empty: none. */
  private describeWaiting(): string {
    const lease = [...this.requested].map((robot) => this.state.lease(robot)).find(awaitsConsent);
    return lease ? `waiting for ${this.state.nameOf(lease.holder)}'s consent to ${lease.target}` : "";
  }

  private takeInbox(update: Extract<FromWorker, { type: "inbox" }>): void {
    this.marks.takeInbox(update);
    for (const message of update.messages) {
      if (message.type === "event" && message.body.event === "notice") this.takeNotice(message.body);
      if (message.type !== "feedback") continue;
      const pulse = findPulse(this.feedback.get(message.robot) as typeof message | undefined, message);
      this.feedback.set(message.robot, message);
      if (!pulse) continue;
      const side = [...this.hands.driven].find(([, robot]) => robot === message.robot)?.[0];
      const source = [...this.session.inputSources].find(({ handedness }) => handedness === side);
      const [actuator] = (source?.gamepad as { hapticActuators?: HapticActuator[] } | undefined)?.hapticActuators ?? [];
      void actuator?.pulse?.(pulse.intensity, pulse.duration_ms);
    }
  }

  /** Show why a press of the wearer's button did nothing; what refuses an alignment has lines of its own. */
  private takeNotice(notice: { text: string; participant: string; reason: string }): void {
    const isShown = ["", "alignment_refused", "view_only"].includes(notice.reason);
    if (notice.participant === this.state.selfId && !isShown) this.show(notice.text);
  }

  // --- panels ---------------------------------------------------------------------------------------------------------

  private updatePanels(reading: FrameReading): void {
    const { state } = this;
    const { session, phase, alignment } = state;
    const report = state.status?.participants.find(({ id }) => id === state.selfId)?.alignment_report;
    this.props.isRaised = this.marks.isActive;
    const steps = this.marks.describe(reading.capture_ms);
    const urgent = describeUrgent({
      isStopped: session?.estop ?? false,
      pause: state.pause ? pauseWords(state.pause.by, state.pause.reason) : "",
      connection: state.isReady ? "" : phase.text || "joining the session again",
      isAligned: this.isAligned || steps.length > 0,
      hasMarks: this.marks.hasMarks,
      doubt: steps.length > 0 ? "" : doubtWords(report),
      isTransparent: this.isTransparent,
      canPlace: this.canPlace,
      advice: report?.advice ?? "",
      notice: performance.now() < this.notice.until_ms ? this.notice.text : "",
    });
    const episode = session?.episode ?? null;
    const lines = describeEpisode(state).flatMap(wrap);
    this.props.urgent.setText([...urgent, ...steps, ...(isUrgent(episode) ? lines : [])], URGENT_COLOR);
    const driven = [...this.hands.driven].map(([side, robot]) => `${side} hand: ${robot}`);
    const color = participantColor(state.selfId);
    this.props.status.setText([state.self?.name ?? "", ...wrap(describeAlignment(alignment)), ...driven, ...lines], color);
    for (const side of SIDES) {
      const input = reading.inputs.find((one) => one.side === side);
      this.props.describeHand(side, input ? describeHand(input.emulated, this.marks.isActive ? null : this.hands.findIgnored(side)) : []);
    }
    this.pictures.update();
    const robots = session?.robots ?? [];
    for (const name of this.labels.keys()) if (!robots.some((robot) => robot.name === name)) this.removePanel(name);
    for (const { name } of robots) this.updatePanel(name, reading);
  }

  private updatePanel(name: string, reading: FrameReading): void {
    const { state } = this;
    const lease = state.lease(name);
    const isOwn = lease !== undefined && (lease.holder === state.selfId || lease.sub_holders.includes(state.selfId));
    const sides = SIDES.filter((side) => this.pointed[side] === name);
    const lines = describeRobot({
      name,
      lease,
      holdReason: state.holdReason(name),
      limits: state.feedback.get(name)?.limits ?? [],
      selfId: state.selfId,
      isStopped: state.session?.estop ?? false,
      isPaused: state.pause !== null,
      nameOf: (id) => state.nameOf(id),
      isPointedAt: sides.length > 0,
      isOwn,
      isRequested: this.requested.has(name),
    });
    const share = Math.max(0, ...sides.map((side) => this.hands.releaseShare(side, reading.capture_ms)));
    if (share > 0) lines.push(drawBar(share));
    const label = this.labels.get(name) ?? this.addPanel(name);
    label.setText(lines, lease?.holder ? participantColor(lease.holder) : FREE_COLOR);
    const points = (this.chains.get(name) ?? []).map((body) => this.positionOf(body)).filter((point) => point !== null);
    label.sprite.visible = points.length > 0;
    const base = points.at(-1);
    if (!base) return;
    label.sprite.position.set(base[0], base[1], Math.max(...points.map(([, , z]) => z)) + PANEL_ABOVE_M);
    const [at, eyes] = [label.sprite.getWorldPosition(new Vector3()), this.camera.getWorldPosition(new Vector3())];
    label.setHeight(PANEL_LINE_SHARE * at.distanceTo(eyes));
  }

  private addPanel(name: string): Label {
    const label = new Label(PANEL_LINE_SHARE);
    label.sprite.center.set(0.5, 0); // it grows upwards
    this.labels.set(name, label);
    this.panels.add(label.sprite);
    return label;
  }

  private removePanel(name: string): void {
    this.labels.get(name)?.dispose();
    this.labels.delete(name);
  }
}

/** Vibration motors of controllers: not in the types of TypeScript. */
interface HapticActuator {
  pulse?(intensity: number, duration_ms: number): Promise<boolean>;
}
