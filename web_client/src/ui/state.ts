// What the page knows: the newest update of each kind, the roster by id, the history of events. Panels read it.

import {
  type AssetProgress,
  type BudgetUpdate,
  type Filled,
  type IdentityUpdate,
  type InboxMessage,
  type InfoUpdate,
  type Lease,
  nowMs,
  type ParticipantInfo,
  type PhaseUpdate,
  type SceneSpec,
  type SessionUpdate,
  type StatsUpdate,
  type StatusReport,
  type WelcomeUpdate,
} from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import type * as wire from "../protocol/messages.g.ts";
import { HoldReason } from "../protocol/messages.g.ts";
import { recall, remember } from "./storage.ts";
import type { Mode } from "./stream_choices.ts";
import { type EventLevel, eventWords, formatSessionTime } from "./words.ts";

const MAX_EVENTS = 300;
/** Behind the session's newest frame: more than frames need on their way. */
const BEHIND_MS = 2000;
/** Frames of a stream, one of which comes here at least, by class (docs/protocol.md). In class `none` none comes. */
const FRAMES_BETWEEN: Readonly<Record<string, number>> = { half: 2, quarter: 32 };

export interface LogEntry {
  seq: number;
  session_time: number;
  text: string;
  level: EventLevel;
  /** Of a line that counts on what happens again: its kind and participant. Else empty. */
  key: string;
  /** How often it happened. */
  count: number;
}

export interface ConsentAsked {
  consent_id: number;
  target: string;
  requester: string;
  holder: string;
  until_ms: number;
}

const TABS_KEY = "iris-session.tabs";
/** Participants that are remembered as tabs of this browser, the newest. */
const MAX_TABS = 16;
const HAND = "hand";
/** State of a robot that does not move. */
const HOLD = "hold";
/** Id of the session's own program among those who do something. */
const HOST = "host";

/** What a page says it is when it joins. */
export interface Entry {
  devices: wire.Device[];
  alignment: wire.AlignmentKind;
}

export const DESKTOP: Entry = { devices: ["desktop"], alignment: "not_needed" };

const NO_PHASE: PhaseUpdate = {
  type: "phase",
  phase: "idle",
  text: "",
  refusal: "",
  advice: "",
  close_code: 0,
  stalled: false,
  ended: false,
};

/** State of the page. */
export class PageState {
  /** What this page is now: one with a screen, or a headset. */
  entry = DESKTOP;
  mode: Mode = "screen";
  /** This browser can enter AR. */
  offersAr = false;
  phase: PhaseUpdate = NO_PHASE;
  info: InfoUpdate | null = null;
  identity: IdentityUpdate | null = null;
  welcome: WelcomeUpdate["welcome"] | null = null;
  session: SessionUpdate | null = null;
  status: StatusReport | null = null;
  stats: StatsUpdate | null = null;
  budget: BudgetUpdate["budget"] | null = null;
  progress: AssetProgress | null = null;
  spec: SceneSpec | null = null;
  /** Newest feedback by robot: of those that this page holds. */
  readonly feedback = new Map<string, Filled<wire.Feedback>>();
  readonly log: LogEntry[] = [];
  consents: ConsentAsked[] = [];
  rtt_ms = Number.NaN;
  /** Who paused the session and why; null where this page has not seen it. */
  private seenPause: { participant: string; reason: string } | null = null;
  private sessionOffset_ms = Number.NaN;
  /** The alignment is void if it is to this tracking frame or one before. */
  private voidEpoch = Number.NaN;
  /** Times of the newest cloud or picture of a stream, while it is subscribed to. */
  private readonly newest = new Map<string, { capture_ms: number; received_ms: number }>();
  /** Names of participants that left, for events about them. */
  private readonly formerNames = new Map<string, string>();
  /** Versions of alignments that the history has. */
  private readonly alignmentVersions = new Map<string, number>();
  private readonly listeners: ((state: PageState) => void)[] = [];
  /** Participants of this browser in this session. */
  private ownIds: string[] = [];
  private isQueued = false;
  private nextSeq = 1;

  constructor(client: WorkerClient) {
    const keep = <K extends "phase" | "info" | "identity" | "session" | "stats">(type: K): void => {
      client.on(type, (update) => {
        (this as Record<K, unknown>)[type] = update;
        this.touch();
      });
    };
    keep("phase");
    keep("info");
    keep("identity");
    keep("stats");
    client.on("session", (update) => {
      for (const { id, name } of update.participants) this.formerNames.set(id, name);
      this.session = update;
      if (!update.paused) this.seenPause = null;
      if (!this.self?.alignment) this.voidEpoch = Number.NaN; // the numbers may begin again
      this.touch();
    });
    client.on("welcome", ({ welcome }) => {
      if (this.welcome !== null && this.welcome.session_id !== welcome.session_id) this.forgetSession();
      this.welcome = welcome;
      this.noteTab(welcome);
      this.feedback.clear();
      this.consents = [];
      this.alignmentVersions.clear(); // of another session they may be the same
      this.touch();
    });
    client.on("status", ({ status }) => {
      this.status = status;
      this.touch();
    });
    client.on("budget", ({ budget }) => {
      this.budget = budget;
      this.forgetFrames((stream) => !budget.streams.some((one) => one.stream === stream));
      this.touch();
    });
    client.on("cloud", ({ stream, capture_ms, received_ms }) => this.newest.set(stream, { capture_ms, received_ms }));
    client.on("picture", ({ stream, capture_ms, received_ms }) => this.newest.set(stream, { capture_ms, received_ms }));
    client.on("asset_progress", (progress) => {
      this.progress = progress;
      this.touch();
    });
    client.on("clock", ({ rtt_ms, session_offset_ms }) => {
      this.rtt_ms = rtt_ms;
      this.sessionOffset_ms = session_offset_ms;
      this.touch();
    });
    client.on("inbox", ({ messages }) => {
      for (const message of messages) this.take(message);
      this.touch();
    });
  }

  /** Another session is joined: forget what belongs to the one before. */
  private forgetSession(): void {
    this.log.length = 0;
    this.session = this.status = this.stats = this.budget = this.progress = this.seenPause = null;
    this.rtt_ms = this.sessionOffset_ms = this.voidEpoch = Number.NaN;
    this.newest.clear();
    this.formerNames.clear();
  }

  /** Let the other tabs of this browser know which participant this one is. */
  private noteTab({ session_id, participant_id }: WelcomeUpdate["welcome"]): void {
    const known = recall(TABS_KEY, { session: "", ids: [] as string[] });
    const others = known.session === session_id ? known.ids.filter((id) => id !== participant_id) : [];
    this.ownIds = [...others.slice(1 - MAX_TABS), participant_id];
    remember(TABS_KEY, { session: session_id, ids: this.ownIds });
  }

  onChange(listener: (state: PageState) => void): void {
    this.listeners.push(listener);
  }

  /** Call the listeners soon: at the next frame, or after a moment in background tabs and headsets, where none comes. */
  touch(): void {
    if (this.isQueued) return;
    this.isQueued = true;
    const run = (): void => {
      if (!this.isQueued) return;
      this.isQueued = false;
      for (const listener of this.listeners) listener(this);
    };
    requestAnimationFrame(run);
    setTimeout(run, 200);
  }

  get selfId(): string {
    return this.session?.participant_id ?? "";
  }

  get self(): ParticipantInfo | undefined {
    return this.participant(this.selfId);
  }

  /** Own alignment, null for none and for one to a tracking frame that is gone. */
  get alignment(): ParticipantInfo["alignment"] {
    const alignment = this.self?.alignment ?? null;
    return alignment !== null && alignment.tracking_epoch <= this.voidEpoch ? null : alignment;
  }

  /** The tracking frame has jumped: the alignment is void, whether or not the session can be told now. */
  voidAlignment(): void {
    this.voidEpoch = this.self?.alignment?.tracking_epoch ?? Number.NaN;
  }

  /** Role of this page in the session, empty before it has joined. */
  get role(): string {
    return this.self?.role ?? this.welcome?.role ?? "";
  }

  get isDirector(): boolean {
    return this.role === "director";
  }

  get isReady(): boolean {
    return this.phase.phase === "ready";
  }

  /** Who paused the session, empty where that is not known, and why; null while it runs. */
  get pause(): { by: string; reason: string } | null {
    if (!this.session?.paused) return null;
    const { participant = "", reason = "" } = this.seenPause ?? {};
    return { by: participant ? this.nameOf(participant) : (this.status?.paused_by ?? ""), reason: reason || (this.status?.pause_reason ?? "") };
  }

  participant(id: string): ParticipantInfo | undefined {
    return this.session?.participants.find((participant) => participant.id === id);
  }

  /** Return the name of a participant, with the id where another present one has the same. `before`: of one that is not known. */
  nameOf(id: string, before = id): string {
    if (id === HOST) return "the session";
    const name = this.participant(id)?.name ?? this.formerNames.get(id) ?? before;
    const isShared = this.session?.participants.some((other) => other.id !== id && other.name === name) ?? false;
    return isShared ? `${name} (${id})` : name;
  }

  lease(robot: string): Lease | undefined {
    return this.session?.leases.find((lease) => lease.target === robot && lease.kind === "robot");
  }

  /** Return whether a robot follows a pose or a velocity; a hand follows joints only, which programs and gloves send. */
  followsPoses(robot: string): boolean {
    return this.session?.robots.find(({ name }) => name === robot)?.kind !== HAND;
  }

  /** Return how old the newest cloud or picture of a stream is [ms]; undefined: this page has none. */
  ageOf(stream: string): number | undefined {
    const newest = this.newest.get(stream);
    return newest === undefined || Number.isNaN(this.sessionOffset_ms) ? undefined : nowMs() + this.sessionOffset_ms - newest.capture_ms;
  }

  /** Return whether the session has had a newer cloud or picture of a stream than this page for so long that it shows what was. */
  isBehind(stream: string): boolean {
    const received_ms = this.newest.get(stream)?.received_ms ?? 0;
    const report = this.status?.media.find((one) => one.stream === stream);
    if (received_ms === 0 || !this.status || !report) return false;
    const budgetClass = this.budget?.streams.find((one) => one.stream === stream)?.budget_class ?? "";
    const between_ms = report.hz > 0 ? (1000 * (FRAMES_BETWEEN[budgetClass] ?? 0)) / report.hz : 0;
    return this.status.session_time / 1e6 - report.age_ms - received_ms > BEHIND_MS + between_ms;
  }

  /** Forget the frames of streams that are not shown any more. */
  forgetFrames(isForgotten: (stream: string) => boolean): void {
    for (const stream of this.newest.keys()) if (isForgotten(stream)) this.newest.delete(stream);
  }

  /** Names of robots that a participant holds. */
  heldBy(id: string): string[] {
    const leases = this.session?.leases ?? [];
    return leases.filter((l) => l.holder === id || l.sub_holders.includes(id)).map((l) => l.target);
  }

  /**
   * Return why a robot holds now, empty: it does not, or that is not known. Own robots by their feedback, others by the
   * newest report while that is of the same holder: it may be a second old. What has passed since is no reason.
   */
  holdReason(robot: string): string {
    const holder = this.lease(robot)?.holder ?? "";
    if (holder === "") return "";
    const isOwn = this.heldBy(this.selfId).includes(robot);
    const reported = this.report(robot)?.hold_reason ?? (isOwn ? HoldReason.NO_SAMPLE : "");
    const reason = (isOwn ? this.feedback.get(robot)?.hold_reason : undefined) ?? reported;
    if (reason === HoldReason.ESTOP && !this.session?.estop) return HoldReason.REARM;
    return reason === HoldReason.NO_LEASE ? HoldReason.NO_SAMPLE : reason;
  }

  /** Return whether something moves a robot now, as far as is known. */
  isMoved(robot: string): boolean {
    const own = this.heldBy(this.selfId).includes(robot) ? this.feedback.get(robot) : undefined;
    return ((own ?? this.report(robot))?.state ?? HOLD) !== HOLD;
  }

  /** Return the newest report about a robot, if that is of its present holder. */
  private report(robot: string): StatusReport["robots"][number] | undefined {
    const report = this.status?.robots.find(({ name }) => name === robot);
    return report?.holder === (this.lease(robot)?.holder ?? "") ? report : undefined;
  }

  /** Return the name of a holder, and whether it is this person in another tab. */
  holderName(id: string): string {
    return `${this.nameOf(id)}${this.ownIds.includes(id) ? ", your other tab" : ""}`;
  }

  /** Add a line of the page's own to the history. */
  note(text: string, level: EventLevel = "info"): void {
    this.addLog(this.sessionTime(), text, level);
    this.touch();
  }

  private take(message: InboxMessage): void {
    if (message.type === "feedback") this.feedback.set(message.robot, message);
    else if (message.type === "event") this.takeEvent(message);
    else if (message.type === "protocol_fault") this.takeFault(message);
  }

  private takeFault({ code, message }: Filled<wire.ProtocolFault>): void {
    if (code === "stalled") this.addStall(this.sessionTime(), message, true);
    else if (code === "recovered") this.addStall(this.sessionTime(), "the session stood still for a moment, and steps again", false);
    else this.addLog(this.sessionTime(), message, "warning");
  }

  /** Add a line about a session that stands still, or did. A busy machine does so again and again: that is one line. */
  private addStall(session_time: number, text: string, isNext: boolean): void {
    const before = this.findLine("stall")?.count ?? 0;
    const count = before === 0 || isNext ? before + 1 : before;
    this.countOn("stall", session_time, count > 1 ? `${text} (${count} times)` : text, count);
  }

  /** Add a line, or change the one with the same key where it is. */
  private countOn(key: string, session_time: number, text: string, count: number): void {
    const line = this.findLine(key);
    if (!line) this.addLog(session_time, text, "warning", key, count);
    else Object.assign(line, { text: count > 1 ? `${text}, last at ${formatSessionTime(session_time)}` : text, count });
  }

  private findLine(key: string): LogEntry | undefined {
    return this.log.find((entry) => entry.key === key);
  }

  private takeEvent({ session_time, body }: Filled<wire.Event>): void {
    if (body.event === "participant_joined") this.formerNames.set(body.participant.id, body.participant.name);
    if (body.event === "pause_changed") this.seenPause = body.paused ? body : null;
    if (body.event === "consent_requested" && body.holder === this.selfId) {
      const timeout_ms = (this.session?.consent_timeout_ns ?? 0) / 1e6 || 15_000;
      this.consents.push({ ...body, until_ms: performance.now() + timeout_ms });
    }
    if (body.event === "lease_changed") {
      this.consents = this.consents.filter((asked) => asked.target !== body.lease.target || body.cause === "queue");
    }
    if (body.event === "alignment_changed") {
      const { version } = body.alignment;
      if (this.alignmentVersions.get(body.participant) === version) return; // it has aged: the panel says by how much
      this.alignmentVersions.set(body.participant, version);
    }
    const words = eventWords(body, (id) => this.nameOf(id));
    if (!words) return;
    if (body.event === "gap" && body.kind === "stalled") this.addStall(session_time, words.text, false);
    else if (body.event === "samples_rejected") this.countOn(`rejected ${body.participant} ${body.device} ${body.reason}`, session_time, words.text, body.count);
    else this.addLog(session_time, words.text, words.level);
  }

  /** Session time now [ns], 0 before the clock is known. */
  sessionTime(): number {
    return Number.isNaN(this.sessionOffset_ms) ? 0 : Math.round(1e6 * (nowMs() + this.sessionOffset_ms));
  }

  private addLog(session_time: number, text: string, level: EventLevel, key = "", count = 0): void {
    this.log.unshift({ seq: this.nextSeq++, session_time, text, level, key, count });
    this.log.length = Math.min(this.log.length, MAX_EVENTS);
  }
}
