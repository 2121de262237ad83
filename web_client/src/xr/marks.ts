// Touched marks in a headset: gives `Touching` its frames and answers, sends what it reports, shows where the next mark is
// expected and where tips are, and keeps the place for the next visit.

import { BufferGeometry, Float32BufferAttribute, Group, Line, LineBasicMaterial, type Material, Mesh, MeshBasicMaterial, Quaternion, RingGeometry, SphereGeometry, Vector3 } from "three";

import type { AnchorPlace, FromWorker, ObservationInput } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { DatabaseStore, type Store } from "../core/storage.ts";
import type { Actions } from "../ui/actions.ts";
import type { PageState } from "../ui/state.ts";
import { Label } from "../view/labels.ts";
import { keepTips, PlaceKeeper, recallTips } from "./kept_places.ts";
import { covarianceAtAnchor } from "./poses.ts";
import { moveTo } from "./props.ts";
import { BUTTON, type FrameReading, type Side, toRow } from "./reading.ts";
import { type Facts, locateAnchor, MIN_TOUCHES, type Outcome, Touching } from "./touching.ts";
import { isPlaced, isViewOnly } from "./words.ts";

/** Time between two reports of a kept place [ms]. */
const REPORT_MS = 2000;
const COLOR = 0x35d0ba;
/** Ring about the expected mark, height of the line above it, and radius of a tip [m]. */
const RING_M = [0.012, 0.016] as const;
const POLE_M = 0.1;
const TIP_M = 0.003;
const PULSE = [0.6, 60] as const;
const IS_KEPT = "This headset keeps the place: after a reload, touch one mark.";
const IS_CONFIRMED = "One mark confirms the kept place. To be more exact, hold a trigger for two seconds and touch all.";
const IS_NOT_KEPT = "This browser keeps no places: touch the marks again after a reload.";

/** The marks of one immersive session. Add `group` to the tracking frame. */
export class Marks {
  readonly group = new Group();
  readonly touching = new Touching();
  private readonly ring: Group;
  private readonly label = new Label(0.02);
  private readonly tips: Mesh[] = [];
  private keeper: PlaceKeeper | null = null;
  private store: Store | null = null;
  private memory = "";
  private reported_ms = Number.NEGATIVE_INFINITY;

  constructor(
    private readonly session: XRSession,
    /** Marks are seen: the room is. */
    private readonly isTransparent: boolean,
    private readonly state: PageState,
    private readonly client: WorkerClient,
    private readonly actions: Actions,
  ) {
    this.group.name = "marks";
    this.ring = makeRing();
    this.ring.add(this.label.sprite);
    this.label.sprite.position.y = POLE_M + 0.02;
    this.group.add(this.ring);
    void this.recall();
  }

  /** The person touches marks: triggers, squeezes, A, B, X and Y mean nothing else. */
  get isActive(): boolean {
    return this.touching.isActive;
  }

  /** The session has a sheet with marks. */
  get hasMarks(): boolean {
    return this.findSheet() !== null;
  }

  /** Return a reading without squeezes and buttons that are meant for the marks. */
  mask(reading: FrameReading): FrameReading {
    if (!this.isActive) return reading;
    const left = ~(BUTTON.trigger | BUTTON.squeeze | BUTTON.lower | BUTTON.upper);
    const inputs = reading.inputs.map((one) => ({ ...one, squeeze: 0, buttons: one.buttons & left }));
    return { ...reading, inputs };
  }

  /** Take a frame in which the person's input reaches the scene. */
  onFrame(frame: XRFrame, space: XRReferenceSpace, reading: FrameReading, busy: readonly Side[]): void {
    const facts = this.collectFacts(busy);
    for (const outcome of this.touching.update(reading, facts)) this.act(outcome, frame, space, facts);
    this.reportKept(frame, space, reading.capture_ms, facts);
    this.show(reading, facts);
  }

  /** Return the lines of the panel before the eyes. */
  describe(now_ms: number): string[] {
    return this.touching.describe(this.state, now_ms, this.memory);
  }

  /** Take what the session says. */
  takeInbox({ messages }: Extract<FromWorker, { type: "inbox" }>): void {
    for (const message of messages) {
      if (message.type !== "event") continue;
      const { body } = message;
      if (body.event === "headsets_compared") this.takeComparison(body);
      if (!("participant" in body) || body.participant !== this.state.selfId) continue;
      if (body.event === "tip_calibrated") this.takeTip(body);
      else if (body.event === "notice" && body.reason === "alignment_refused") this.touching.onRefused(body.text);
      else if (body.event === "alignment_alarmed" && body.kind === "jump") this.touching.reset();
      else if (body.event === "alignment_run" && body.running) this.touching.begin();
    }
  }

  dispose(): void {
    this.label.dispose();
    for (const child of [...this.ring.children, ...this.tips]) {
      if (!(child instanceof Mesh || child instanceof Line)) continue;
      child.geometry.dispose();
      (child.material as Material).dispose();
    }
    this.group.removeFromParent();
  }

  // --- session --------------------------------------------------------------------------------------------------------

  private collectFacts(busy: readonly Side[]): Facts {
    const { state } = this;
    const anchor = this.findSheet();
    const isReady = state.isReady && (state.self?.devices.includes("head") ?? false);
    return { anchor, alignment: state.alignment, isReady, isOffered: this.isTransparent && this.store !== null, busy };
  }

  private findSheet(): AnchorPlace | null {
    return this.state.session?.anchors.find(({ marks }) => marks.length >= MIN_TOUCHES) ?? null;
  }

  private act(outcome: Outcome, frame: XRFrame, space: XRReferenceSpace, { alignment }: Facts): void {
    if (outcome.type === "observe") this.send(outcome.observation);
    else if (outcome.type === "restart") void this.actions.request({ type: "align", action: "start", participant: this.state.selfId });
    else if (outcome.type === "pulse") this.pulse(outcome.side);
    else {
      this.memory = outcome.isConfirmed ? IS_CONFIRMED : "";
      if (!outcome.isMeasured || alignment?.kind !== "measured" || alignment.offset || !this.keeper) return;
      const { anchor } = outcome;
      const T_tracking_anchor = locateAnchor(alignment, anchor);
      const covariance = covarianceAtAnchor(alignment, anchor.T_world_anchor);
      if (covariance.length === 0) return;
      void this.keeper.keep(frame, space, anchor.anchor_id, T_tracking_anchor, covariance).then((isKept) => (this.memory = isKept ? IS_KEPT : IS_NOT_KEPT));
    }
  }

  private send(observation: ObservationInput): void {
    this.client.post({ type: "observation", observation });
  }

  /** Report where the kept place is, until it is confirmed: a new connection or run of the alignment knows nothing of it. */
  private reportKept(frame: XRFrame, space: XRReferenceSpace, now_ms: number, { isReady, alignment }: Facts): void {
    if (!isReady || (isPlaced(alignment) && !isViewOnly(alignment)) || now_ms - this.reported_ms < REPORT_MS) return;
    const observation = this.keeper?.observe(frame, space, now_ms);
    if (!observation) return;
    this.reported_ms = now_ms;
    this.send(observation);
  }

  private takeTip(answer: Parameters<Touching["onTip"]>[0]): void {
    this.touching.onTip(answer);
    if (!answer.refused && this.store) keepTips(this.store, this.owner, this.touching.tips);
  }

  private takeComparison(compared: Parameters<Touching["onCompared"]>[1]): void {
    const { a, b, touched } = compared;
    const { selfId } = this.state;
    if (touched && (a === selfId || b === selfId)) this.touching.onCompared(this.state.nameOf(a === selfId ? b : a), compared);
  }

  private get owner(): string {
    return `${this.state.info?.session_id ?? ""} ${this.state.selfId}`;
  }

  private async recall(): Promise<void> {
    const store = await DatabaseStore.open();
    const keeper = new PlaceKeeper(this.session, store, this.state.info?.session_name ?? "");
    for (const [device, tip] of await recallTips(store, this.owner)) if (!this.touching.tips.has(device)) this.touching.tips.set(device, tip);
    this.store = store; // from now on marks are asked for: with the tips that are known
    await keeper.restore();
    this.keeper = keeper;
  }

  private pulse(side: Side): void {
    const source = [...this.session.inputSources].find(({ handedness }) => handedness === side);
    const [actuator] = (source?.gamepad as { hapticActuators?: { pulse?: (...pulse: readonly number[]) => Promise<boolean> }[] } | undefined)?.hapticActuators ?? [];
    void actuator?.pulse?.(...PULSE);
  }

  // --- pictures -------------------------------------------------------------------------------------------------------

  private show(reading: FrameReading, facts: Facts): void {
    const expected = this.isTransparent ? this.touching.findExpected(facts) : null;
    this.ring.visible = expected !== null;
    if (expected) {
      const [x, y, z, qx, qy, qz, qw] = toRow(expected.pose) as [number, number, number, number, number, number, number];
      this.ring.position.set(x, y, z);
      this.ring.quaternion.set(qx, qy, qz, qw);
      this.label.setText([expected.mark], "#35d0ba");
    }
    const points = this.touching.listTips(reading);
    while (this.tips.length < points.length) this.tips.push(this.addTip());
    this.tips.forEach((tip, i) => {
      const point = points[i];
      tip.visible = point !== undefined;
      if (point) moveTo(tip, point);
    });
  }

  private addTip(): Mesh {
    const tip = new Mesh(new SphereGeometry(TIP_M, 16, 12), new MeshBasicMaterial({ color: COLOR, depthTest: false }));
    tip.renderOrder = 15;
    this.group.add(tip);
    return tip;
  }
}

/** Return a ring that lies on its sheet, and a line that points to its middle from above. */
function makeRing(): Group {
  const group = new Group();
  const ring = new Mesh(new RingGeometry(...RING_M, 48), new MeshBasicMaterial({ color: COLOR, depthTest: false }));
  ring.quaternion.copy(new Quaternion().setFromAxisAngle(new Vector3(1, 0, 0), -Math.PI / 2));
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute([0, RING_M[1], 0, 0, POLE_M, 0], 3));
  group.add(ring, new Line(geometry, new LineBasicMaterial({ color: COLOR, depthTest: false })));
  for (const child of group.children) child.renderOrder = 15;
  group.visible = false;
  return group;
}
