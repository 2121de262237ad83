// Words for what the session reports: names of enumerations, numbers with units, sentences about events. Pure.

import type { Filled } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";
import { AlarmKind, AlignmentDoubt, AuditKind, BudgetClass, DenialReason, type HoldReason, StreamFault } from "../protocol/messages.g.ts";

/** What helps when the clutch has to be opened and closed, whatever the clutch is: a key, a handle, a squeeze. */
const AGAIN = "let go, then hold again";

const HOLD_REASONS: Record<(typeof HoldReason)[keyof typeof HoldReason], string> = {
  no_lease: "no participant has its lease",
  no_sample: "its holder sends nothing yet",
  clutch_open: "the operator has let go",
  stale: `samples came too late: ${AGAIN}`,
  not_worn: "headset taken off",
  untracked: "tracking lost",
  unaligned: "its holder is not aligned",
  view_only: "its holder is aligned well enough to look, not to drive",
  unconfirmed: "the alignment of its holder is doubted: glance at a sheet, or touch three marks",
  rejected: `a sample was rejected: ${AGAIN}`,
  estop: "e-stop",
  disconnected: "its holder is disconnected",
  gap: `the session stood still: ${AGAIN}`,
  scene_changed: `the scene changed: ${AGAIN}`,
  intervention: "a person took over",
  rearm: AGAIN,
  emulated: `out of sight, its position is a guess: bring the hand into view, ${AGAIN}`,
  zero_pose: `the device has no pose yet: wait until it is tracked, ${AGAIN}`,
  frozen: `the pose of the device is frozen: move or wake it, ${AGAIN}`,
  jump: `tracking jumped: ${AGAIN}`,
  episode: `an episode is closing: ${AGAIN}`,
};

/** Limits of control, but for names of joints (docs/guide.md): what an operator has to know first comes first. */
const LIMITS: Record<string, string> = {
  tracking: "pushing against something, or the load is too heavy",
  joints_only: "moves by its joints only, not by a pose",
  workspace: "at the edge of its workspace",
  reach: "arm at full reach",
  singular: "arm stretched out or folded: it cannot move every way",
  proximity: "slowed down: another robot is near",
  leader_apart: "catching up with its leader",
  sag: "hanging lower than it should: the load is heavy",
  speed: "as fast as it may move",
};

const LEASE_MODES: Record<string, string> = {
  exclusive: "exclusive",
  request: "on request",
  takeover: "take over",
  priority: "people first",
  shared: "shared",
};

const ROLES: Record<string, string> = {
  operator: "operator",
  observer: "observer",
  director: "director",
  agent: "agent",
  leader: "leader robot",
  gateway: "gateway",
  recorder: "recorder",
  camera: "camera",
  source: "source",
};

const ALIGNMENTS: Record<string, string> = {
  none: "not aligned",
  measured: "measured",
  placed: "placed by hand",
  fingertip: "by fingertip, to look",
  persistent: "by a kept anchor, to look",
  not_needed: "not needed",
};

const LEASE_CAUSES: Record<string, string> = {
  acquired: "took",
  takeover: "took over",
  assigned: "was assigned",
  resumed: "has again",
  consent: "was given",
  priority: "took over",
};

const EPISODE_STATES: Record<string, string> = {
  countdown: "begins soon",
  confirm: "discard it?",
  left: "its leader is disconnected",
};

const STREAM_FAULTS: Record<string, string> = {
  frozen: "its camera repeats one frame",
  no_depth: "its camera measures no depth",
  saturated: "its depth is saturated",
  size: "its frames have another size than configured",
  moved: "its camera was moved: calibrate it again",
  pose: "the pose of its camera is not valid",
  clock: "its clock jumps",
  slow: "its source is too slow",
  source: "its source fails",
};

/** Return the words of a value, or the value itself for one that this page does not know. */
const look = (table: Record<string, string>, value: string): string => table[value] ?? value.replaceAll("_", " ");

/** Return why a robot holds. `isOwn`: to the person who drives it. */
export function holdReasonWords(reason: string, isOwn = false): string {
  const words = look(HOLD_REASONS, reason);
  return isOwn ? words : words.replace(AGAIN, "it waits for its operator");
}

/** Return whether a robot holds until its clutch was opened and closed again: nothing is to be done where it is open. */
export const needsAgain = (reason: string): boolean => look(HOLD_REASONS, reason).endsWith(AGAIN);

/** Return in words what keeps a robot from going on: the first two things. */
export function limitWords(limits: readonly string[]): string {
  const known = Object.keys(LIMITS);
  const rank = (limit: string): number => (limit in LIMITS ? known.indexOf(limit) : 0.5); // joints come after `tracking`
  return [...limits].sort((a, b) => rank(a) - rank(b)).slice(0, 2).map(nameLimit).join(", ");
}

/** Return the words of one of `LIMITS`, or of the joint of that name at the end of its range. */
function nameLimit(limit: string): string {
  const number = /(?:^|[^a-z])joint[ _-]?(\d+)$/i.exec(limit)?.[1];
  const name = limit.slice(limit.lastIndexOf("/") + 1).replace(/^joint_|_joint$/i, "").replaceAll("_", " ");
  return LIMITS[limit] ?? `joint ${number ?? name} at its end`;
}

/** Return the headline about a pause: who paused and why. `by`: name, empty where it is not known. */
export const pauseWords = (by: string, reason: string): string => `Paused${by ? ` by ${by}` : ""}${reason ? `: ${reason}` : ""}`;
export const leaseModeWords = (mode: string): string => look(LEASE_MODES, mode);
export const roleWords = (role: string): string => look(ROLES, role);
export const alignmentWords = (kind: string): string => look(ALIGNMENTS, kind);
export const streamFaultWords = (fault: string): string => look(STREAM_FAULTS, fault);
export const episodeStateWords = (state: string): string => look(EPISODE_STATES, state);

export function formatMillimetres(metres: number): string {
  const mm = 1000 * metres;
  return mm >= 100 ? `${(metres * 100).toFixed(0)} cm` : `${mm.toFixed(mm < 10 ? 1 : 0)} mm`;
}

export function formatMilliseconds(ms: number): string {
  if (!Number.isFinite(ms)) return "–";
  const shown = Math.max(0, ms); // clocks agree to a fraction of a millisecond only
  return shown >= 1000 ? `${(shown / 1000).toFixed(1)} s` : `${shown.toFixed(shown < 10 ? 1 : 0)} ms`;
}

export function formatBytes(bytes: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let [value, unit] = [bytes, 0];
  while (value >= 1000 && unit + 1 < units.length) [value, unit] = [value / 1000, unit + 1];
  return `${value.toFixed(value < 10 && unit > 0 ? 1 : 0)} ${units[unit]}`;
}

/** Return a duration such as `3 s`, `4 min`, `2 h`. */
export function formatAge(ns: number): string {
  const s = Math.max(0, ns / 1e9);
  if (s < 90) return `${s.toFixed(0)} s`;
  return s < 5400 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;
}

/** Return why an alignment is unconfirmed, so that robots hold at the next squeeze; empty: it is not. */
export function doubtWords(report: { doubt: string; confirmed_ns: number } | null | undefined): string {
  if (!report || report.doubt === "") return "";
  if (report.doubt === AlignmentDoubt.UNVERIFIED) return "another wearer has aligned by a sheet since this headset last saw it";
  if (report.doubt === AlignmentDoubt.AGED) return `the alignment is ${formatAge(report.confirmed_ns)} old`;
  return report.doubt === AlignmentDoubt.CONTRADICTED ? "later looks contradict the alignment" : `the alignment is doubted: ${report.doubt.replaceAll("_", " ")}`;
}

/** Return how old the newest frame of a stream is, empty where that is not known. */
export function streamAgeWords(ms: number): string {
  return Number.isFinite(ms) ? `${ms < 1000 ? formatMilliseconds(Math.max(0, ms)) : formatAge(1e6 * ms)} old` : "";
}

const BUDGETS: Record<string, string> = {
  full: "",
  half: "half: the link is too slow for all of it",
  quarter: "quarter: the link is too slow for all of it",
  none: "paused: the link is too slow",
};

/** Return why a stream is delivered in another class than `full`, empty for that. */
export const budgetWords = (budgetClass: string): string => look(BUDGETS, budgetClass);

/** Return why the newest frame of a stream shows what was, or what is wrong; empty for a good one. `isBehind`: newer ones do not come here. */
export function streamStateWords(stream: { stale: boolean; fault: string; budget_class: string }, isBehind: boolean): string {
  const isPaused = stream.budget_class === BudgetClass.NONE;
  const parts = [
    isBehind && !stream.stale ? (isPaused ? budgetWords(stream.budget_class) : "newer frames do not come here") : "",
    stream.stale ? "stale" : "",
    stream.fault ? streamFaultWords(stream.fault) : "",
  ];
  return parts.filter((part) => part !== "").join(", ");
}

/** Return whether what is drawn of a stream shows what was, or what is wrong. A slow source is right, only less often. */
export function isDoubtful(stream: { stale: boolean; fault: string; budget_class: string }, isBehind: boolean): boolean {
  return streamStateWords({ ...stream, fault: stream.fault === StreamFault.SLOW ? "" : stream.fault }, isBehind) !== "";
}

/** Return a whole number with groups of digits, such as `50,000`. */
export const formatCount = (count: number): string => count.toLocaleString("en");

/** Return a session time as minutes and seconds, `12:05.3`. */
export function formatSessionTime(ns: number): string {
  const s = Math.max(0, ns / 1e9);
  const minutes = Math.floor(s / 60);
  return `${minutes}:${(s % 60).toFixed(1).padStart(4, "0")}`;
}

export const formatShare = (share: number): string => `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;

/** Return when a lease whose holder is disconnected becomes free. */
export const graceWords = (expires_ns: number, now_ns: number): string => `its holder is disconnected: free in ${formatAge(expires_ns - now_ns)}`;

/** Return a denial as one sentence: what, who holds it, what to do. The advice for `held` is for programs: this page has a button, for those who may wait. */
export function denialWords(denial: Filled<wire.Denial>): string {
  if (denial.reason === DenialReason.HELD) {
    if (!denial.advice.includes("wait")) return `${capitalize(denial.message)}${endSentence(denial.message)}`;
    denial = { ...denial, advice: "“Wait for it” gives it to you as soon as it is free" };
  }
  const holder = denial.holder_name && !denial.message.includes(denial.holder_name) ? ` Held by ${denial.holder_name}.` : "";
  const advice = denial.advice ? ` ${capitalize(denial.advice)}` : "";
  return `${capitalize(denial.message || denial.reason.replaceAll("_", " "))}${endSentence(denial.message)}${holder}${advice}`;
}

function endSentence(text: string): string {
  return /[.!?:]$/.test(text) ? "" : ".";
}

export function capitalize(text: string): string {
  return text.slice(0, 1).toUpperCase() + text.slice(1);
}

export type EventLevel = "info" | "warning" | "error";

/** An event as a sentence. `nameOf`: the name of a participant id. Null: nothing that people need to read. */
export function eventWords(
  body: Filled<wire.EventKind>,
  nameOf: (participant: string) => string,
): { text: string; level: EventLevel } | null {
  const info = (text: string): { text: string; level: EventLevel } => ({ text, level: "info" });
  const warning = (text: string): { text: string; level: EventLevel } => ({ text, level: "warning" });
  switch (body.event) {
    case "participant_joined":
      return info(`${body.participant.name} ${body.resumed ? "is back" : `joined as ${roleWords(body.participant.role)}`}`);
    case "participant_left":
      return body.grace
        ? warning(`${nameOf(body.participant)} lost the connection (${body.reason.replaceAll("_", " ")}); what it holds is kept for it for a while`)
        : info(`${nameOf(body.participant)} left${body.reason ? ` (${body.reason.replaceAll("_", " ")})` : ""}`);
    case "lease_changed":
      return info(leaseSentence(body.lease, body.cause, body.previous_holder, nameOf));
    case "leases_changed":
      return info(
        body.leases
          .map((lease, i) => leaseSentence(lease, body.cause, body.previous_holders[i] ?? "", nameOf))
          .join("; "),
      );
    case "consent_requested":
      return info(`${nameOf(body.requester)} asks ${nameOf(body.holder)} for ${body.target}`);
    case "intervention":
      return body.active
        ? warning(`${nameOf(body.human)} overrides ${nameOf(body.agent)} on ${body.robot}`)
        : info(`${nameOf(body.agent)} has ${body.robot} again`);
    case "engagement_changed":
      return body.engaged
        ? info(`${nameOf(body.participant)} drives ${body.robot}`)
        : info(`${body.robot} holds${body.reason ? `: ${holdReasonWords(body.reason)}` : ""}`);
    case "scale_changed":
      return info(`motion of ${body.robot} is scaled by ${body.scale}`);
    case "alignment_changed": {
      const { kind, error_at_robot_m } = body.alignment;
      const error = error_at_robot_m > 0 ? `, within ${formatMillimetres(error_at_robot_m)} at the robot` : "";
      return info(`alignment of ${nameOf(body.participant)}: ${alignmentWords(kind)}${error}`);
    }
    case "alignment_run":
      return info(`${nameOf(body.participant)} ${body.running ? "measures its alignment" : "keeps its alignment"}`);
    case "alignment_alarmed":
      if (body.witnesses.length > 0) return null; // a notice says once that the sheet was moved
      if (body.kind === AlarmKind.TWO_PLACES) return warning(`${nameOf(body.participant)} sees ${body.anchor_id} in two places: print each id once`);
      return warning(
        body.kind === "jump"
          ? `the tracking of ${nameOf(body.participant)} jumped by ${formatMillimetres(body.size_m)}: look at the sheet again`
          : `${nameOf(body.participant)} sees ${body.anchor_id} ${formatMillimetres(body.size_m)} from where it was`,
      );
    case "anchor_moved":
      return info(`${body.by ? nameOf(body.by) : "a director"} moved the anchor ${body.anchor_id}`);
    case "headsets_compared": {
      const verb = body.touched ? "touch" : "see";
      const words =
        `${nameOf(body.a)} and ${nameOf(body.b)} ${verb} ${body.anchor_id} ${formatMillimetres(body.error_m)} apart, ` +
        `expected at most ${formatMillimetres(body.expected_p95_m)}`;
      if (body.error_m > body.expected_p95_m) return warning(words);
      return body.touched ? info(words) : null;
    }
    case "scene_changed":
      return info({ reset: "scene reset", new_scene: "another scene", patch: "scene changed" }[body.cause] ?? "time of the scene went back");
    case "estop_changed":
      return body.active
        ? { level: "error", text: `e-stop by ${nameOf(body.participant) || "a connection that has not joined"}${body.reason ? `: ${body.reason}` : ""}` }
        : info(`${nameOf(body.participant)} cleared the e-stop`);
    case "pause_changed":
      return info(`${body.participant ? nameOf(body.participant) : "the session"} ${body.paused ? "paused" : "resumed"}${body.reason ? `: ${body.reason}` : ""}`);
    case "episode_changed":
      return info(`episode ${body.number}: ${episodeStateWords(body.state)}${body.label ? ` (${body.label})` : ""}`);
    case "object_grasped":
      return info(`${nameOf(body.participant)} ${body.grasped ? "took" : "released"} ${body.object} by hand`);
    case "handover":
      return info(`${body.object} was handed over from ${body.giver} to ${body.receiver}`);
    case "marker_added":
      return info(`${nameOf(body.participant)} notes: ${body.text}`);
    case "samples_rejected":
      return warning(`${body.count} samples of ${nameOf(body.participant)} (${body.device}) rejected: ${body.reason.replaceAll("_", " ")}`);
    case "gap":
      return warning(
        body.kind === "recording"
          ? `the recording lacks ${body.rows} steps`
          : body.kind === "resumed"
            ? "the session goes on from an earlier recording"
            : `the session stood still for ${formatAge(body.duration_ns)}`,
      );
    case "notice":
      return { level: body.level === "error" || body.level === "warning" ? body.level : "info", text: body.text };
    case "audited":
      if (body.kind === AuditKind.TOKEN_REFUSED) return null; // a return from an earlier session
      return warning(
        [body.kind.replaceAll("_", " "), body.name, body.address, body.detail, body.count > 1 ? `${body.count} times` : ""]
          .filter((part) => part !== "")
          .join(", "),
      );
    default:
      return null;
  }
}

function leaseSentence(
  lease: Filled<wire.Lease>,
  cause: string,
  previous: string,
  nameOf: (participant: string) => string,
): string {
  if (cause === "mode") return `${lease.target} is now ${leaseModeWords(lease.mode)}`;
  if (cause === "queue") {
    return lease.queue.length > 0 ? `${lease.queue.map(nameOf).join(", ")} wait for ${lease.target}` : `the queue for ${lease.target} is empty`;
  }
  if (lease.holder === "") return `${lease.target} is free${previous ? ` (was held by ${nameOf(previous)})` : ""}`;
  const verb = LEASE_CAUSES[cause];
  const from = previous && previous !== lease.holder ? ` from ${nameOf(previous)}` : "";
  return verb ? `${nameOf(lease.holder)} ${verb} ${lease.target}${from}` : `${nameOf(lease.holder)} has ${lease.target}${from}`;
}
