// An immersive session: reads frames, sends samples, asks for what the hands mean, and shows panels and props. Everything
// that it decides is in the pure files of this folder.

import { Group } from "three";

import type { FromWorker, RobotInfo, SceneSpec } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import type * as wire from "../protocol/messages.g.ts";
import type { Actions } from "../ui/actions.ts";
import type { PageState } from "../ui/state.ts";
import { participantColor } from "../view/avatars.ts";
import { Label } from "../view/labels.ts";
import type { View } from "../view/view.ts";
import { FrameReader } from "./frame_reader.ts";
import { type Context, Hands, type Intent } from "./hands.ts";
import { placeBeforeScene } from "./placement.ts";
import { type Chain, findPointed, listChains } from "./pointing.ts";
import { Props } from "./props.ts";
import { type FrameReading, type Side, toWorldRay, type Vec3 } from "./reading.ts";
import { describeAlignment, describeRobot, describeUrgent, findPulse, wrap } from "./words.ts";

export type Mode = "immersive-ar" | "immersive-vr";

const DEVICES = ["head", "controller/left", "controller/right", "hand/left", "hand/right"];
/** Height of a robot's panel above its highest link [m]. */
const PANEL_ABOVE_M = 0.18;
/** Time that a denial is shown [ms], between two attempts to be placed, and between two updates of the panels. */
const NOTICE_MS = 5000;
const PLACE_PERIOD_MS = 1000;
const PANEL_PERIOD_MS = 100;
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
  private readonly props = new Props();
  private readonly reader: FrameReader;
  /** Panels at robots, in the session's world. */
  readonly panels = new Group();
  private readonly labels = new Map<string, Label>();
  private readonly feedback = new Map<string, wire.Feedback>();
  private pointed: Context["pointed"] = {};
  private chains: ReadonlyMap<string, Chain> = new Map();
  private chainsOf: readonly [readonly RobotInfo[], SceneSpec] | null = null;
  private defaultPlace: wire.Pose | null = null;
  private notice = { text: "", until_ms: 0 };
  private placed_ms = Number.NEGATIVE_INFINITY;
  private panels_ms = Number.NEGATIVE_INFINITY;
  private readonly endListening: () => void;

  constructor(
    readonly session: XRSession,
    mode: Mode,
    private readonly view: View,
    private readonly state: PageState,
    private readonly client: WorkerClient,
    private readonly actions: Actions,
  ) {
    this.isTransparent = mode === "immersive-ar";
    this.reader = new FrameReader(session);
    this.endListening = client.on("inbox", (update) => this.takeInbox(update));
    session.addEventListener("visibilitychange", () => this.onVisibility());
    client.post({ type: "rejoin", devices: DEVICES, alignment: "measured" });
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
  }

  /** Take a frame: before the scene is drawn. */
  onFrame(frame: XRFrame, space: XRReferenceSpace): void {
    const isVisible = this.session.visibilityState === "visible";
    const read = this.reader.read(frame, space);
    // What is covered has no input; its devices are reported where they were, as not tracked.
    const reading = isVisible ? read : { ...read, inputs: this.reading?.inputs ?? [] };
    this.reading = reading;
    const T_world_tracking = this.findPlace();
    this.showsScene = T_world_tracking !== null;
    if (T_world_tracking !== null) this.props.place(T_world_tracking);
    const hits = this.point(reading, T_world_tracking);
    if (isVisible) this.ask(this.hands.update(reading, this.makeContext()));
    else this.hands.suspend();
    const samples = this.hands.makeSamples(reading, isVisible);
    if (samples.length > 0) this.client.post({ type: "samples", samples });
    this.props.move(reading, hits);
    const now = performance.now();
    if (now - this.panels_ms < PANEL_PERIOD_MS) return;
    this.panels_ms = now;
    this.updatePanels(reading);
  }

  /** End: the page is one with a screen again. */
  dispose(): void {
    this.endListening();
    this.props.dispose();
    for (const label of this.labels.values()) label.dispose();
    this.panels.removeFromParent();
    this.client.post({ type: "worn", worn: true });
    this.client.post({ type: "rejoin", devices: ["desktop"], alignment: "not_needed" });
  }

  /** No frames come while the session is hidden: what was held is not tracked any more, at once. */
  private onVisibility(): void {
    const { visibilityState } = this.session;
    this.client.post({ type: "worn", worn: visibilityState !== "hidden" });
    if (visibilityState === "visible" || this.reading === null) return;
    this.client.post({ type: "samples", samples: this.hands.makeSamples(this.reading, false) });
  }

  // --- place ----------------------------------------------------------------------------------------------------------

  private get alignment(): NonNullable<PageState["self"]>["alignment"] | undefined {
    return this.state.self?.alignment;
  }

  private get isAligned(): boolean {
    return this.alignment?.kind === "measured" || this.alignment?.kind === "placed";
  }

  /** Return `T_world_tracking`, null: the scene has no place. */
  private findPlace(): wire.Pose | null {
    const { alignment, state } = this;
    if (alignment && this.isAligned) return alignment.T_world_tracking;
    if (this.isTransparent || !state.spec) return null;
    this.defaultPlace ??= placeBeforeScene(state.spec.environment, this.view.viewpoint.axes.forward);
    this.placeSelf(this.defaultPlace);
    return this.defaultPlace;
  }

  /** In VR nothing of the room is seen, so a director who enters it is aligned by its own word. */
  private placeSelf(T_world_tracking: wire.Pose): void {
    const { state } = this;
    const now = performance.now();
    const isJoined = state.isReady && state.self?.devices.includes("head");
    if (!isJoined || !state.isDirector || now - this.placed_ms < PLACE_PERIOD_MS) return;
    this.placed_ms = now;
    void this.actions.request({ type: "place_alignment", participant: state.selfId, T_world_tracking });
  }

  // --- hands ----------------------------------------------------------------------------------------------------------

  private makeContext(): Context {
    const { state } = this;
    const robots = new Set(state.session?.robots.map(({ name }) => name));
    return {
      held: state.heldBy(state.selfId).filter((name) => robots.has(name)),
      pointed: this.pointed,
      isEpisodeRunning: state.session?.episode?.state === "running",
    };
  }

  /** Find the robots that hands point at. Returns how far away they are [m]. */
  private point(reading: FrameReading, T_world_tracking: wire.Pose | null): Partial<Record<Side, number>> {
    this.pointed = {};
    const hits: Partial<Record<Side, number>> = {};
    const { session, spec } = this.state;
    if (T_world_tracking === null || !session || !spec) return hits;
    if (this.chainsOf?.[0] !== session.robots || this.chainsOf[1] !== spec) {
      this.chains = listChains(session.robots, spec.bodies);
      this.chainsOf = [session.robots, spec];
    }
    for (const { side, ray, tracked } of reading.inputs) {
      if (!ray || !tracked || this.hands.isSqueezing(side)) continue;
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

  private ask(intents: readonly Intent[]): void {
    for (const intent of intents) {
      if (intent.type === "estop") this.actions.estop("thumbstick of a controller");
      else if (intent.type === "episode") void this.actions.request({ type: "episode", action: intent.action });
      else if (intent.type === "acquire") void this.actions.request({ type: "acquire", robots: [intent.robot] });
      else {
        const lease = this.state.lease(intent.robot);
        if (lease) this.actions.release([[intent.robot, lease.lease_version, "robot"]]);
      }
    }
  }

  private takeInbox({ messages }: Extract<FromWorker, { type: "inbox" }>): void {
    for (const message of messages) {
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

  // --- panels ---------------------------------------------------------------------------------------------------------

  private updatePanels(reading: FrameReading): void {
    const { state, alignment } = this;
    const { session, phase } = state;
    const report = state.status?.participants.find(({ id }) => id === state.selfId)?.alignment_report;
    const urgent = describeUrgent({
      isStopped: session?.estop ?? false,
      connection: state.isReady ? "" : phase.text || "joining the session again",
      isAligned: this.isAligned,
      isTransparent: this.isTransparent,
      advice: report?.advice ?? "",
      notice: performance.now() < this.notice.until_ms ? this.notice.text : "",
    });
    this.props.urgent.setText(urgent, URGENT_COLOR);
    const driven = [...this.hands.driven].map(([side, robot]) => `${side} hand: ${robot}`);
    const color = participantColor(state.selfId);
    this.props.status.setText([state.self?.name ?? "", ...wrap(describeAlignment(alignment)), ...driven], color);
    const robots = session?.robots ?? [];
    for (const name of this.labels.keys()) if (!robots.some((robot) => robot.name === name)) this.removePanel(name);
    for (const { name } of robots) this.updatePanel(name, reading);
  }

  private updatePanel(name: string, reading: FrameReading): void {
    const { state } = this;
    const lease = state.lease(name);
    const isOwn = lease !== undefined && (lease.holder === state.selfId || lease.sub_holders.includes(state.selfId));
    const holdReason = (isOwn ? state.feedback.get(name)?.hold_reason : undefined) ?? state.status?.robots.find((robot) => robot.name === name)?.hold_reason ?? "";
    const sides = (["left", "right"] as const).filter((side) => this.pointed[side] === name);
    const lines = describeRobot({
      name,
      lease,
      holdReason,
      selfId: state.selfId,
      isStopped: state.session?.estop ?? false,
      nameOf: (id) => state.nameOf(id),
      isPointedAt: sides.length > 0,
      isOwn,
    });
    const share = Math.max(0, ...sides.map((side) => this.hands.releaseShare(side, reading.capture_ms)));
    if (share > 0) lines.push("▮".repeat(Math.ceil(10 * share)).padEnd(10, "▯"));
    const label = this.labels.get(name) ?? this.addPanel(name);
    label.setText(lines, lease?.holder ? participantColor(lease.holder) : FREE_COLOR);
    const points = (this.chains.get(name) ?? []).map((body) => this.positionOf(body)).filter((point) => point !== null);
    label.sprite.visible = points.length > 0;
    const base = points.at(-1);
    if (base) label.sprite.position.set(base[0], base[1], Math.max(...points.map(([, , z]) => z)) + PANEL_ABOVE_M);
  }

  private addPanel(name: string): Label {
    const label = new Label(0.03);
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
