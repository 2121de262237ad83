// Lines of the panels in the scene, and what is felt in the hand. Pure.

import type { Filled, Lease, ParticipantInfo } from "../core/api.ts";
import { HoldReason } from "../protocol/messages.g.ts";
import type * as wire from "../protocol/messages.g.ts";
import { capitalize, formatMillimetres, holdReasonWords, limitWords } from "../ui/words.ts";

/** Characters of a line. */
const LINE = 44;

export interface RobotFacts {
  name: string;
  lease: Lease | undefined;
  /** Why it holds, empty: it does not, or it is not known. */
  holdReason: string;
  /** What keeps it from going on, while it follows this person. */
  limits: readonly string[];
  selfId: string;
  isStopped: boolean;
  isPaused: boolean;
  nameOf: (participant: string) => string;
  isPointedAt: boolean;
  isOwn: boolean;
  /** One's own request for it has no reply yet. */
  isRequested: boolean;
}

/** Return the lines of the panel at a robot: who holds it, why it stands still, what the trigger does. */
export function describeRobot({ name, lease, holdReason, limits, selfId, isStopped, isPaused, nameOf, isPointedAt, isOwn, isRequested }: RobotFacts): string[] {
  const holder = lease?.holder ?? "";
  const who = isOwn ? "you" : holder === "" ? "free" : nameOf(holder);
  const lines = [`${name}: ${who}`];
  if (isStopped) lines.push("stopped by the e-stop");
  else if (isPaused) lines.push("paused");
  else if (holder !== "" && holdReason !== "") lines.push(...wrap(isOwn ? describeOwnHold(holdReason) : `holds: ${holdReasonWords(holdReason)}`));
  else if (isOwn && holdReason === "" && limits.length > 0) lines.push(...wrap(limitWords(limits)));
  const place = lease?.queue.indexOf(selfId) ?? -1;
  if (lease && place >= 0) lines.push(`you wait for it, place ${place + 1} of ${lease.queue.length}`);
  if (isRequested && awaitsConsent(lease)) lines.push(`waiting for ${who}'s consent`);
  else if (isPointedAt) {
    const verb = awaitsConsent(lease) ? "ask for" : "take";
    lines.push(isOwn ? "hold the trigger to release it" : `press the trigger to ${verb} it`);
  }
  return lines;
}

/** Return why one's own robot holds, in terms of a hand. */
function describeOwnHold(reason: string): string {
  if (reason === HoldReason.CLUTCH_OPEN || reason === HoldReason.NO_SAMPLE) return "squeeze to move it";
  return `holds: ${holdReasonWords(reason, true).replace("hold again", "squeeze again")}`;
}

/** Return whether a request for a robot waits for the consent of its holder. */
export function awaitsConsent(lease: Lease | undefined): lease is Lease {
  return lease !== undefined && lease.mode === "request" && lease.holder !== "";
}

/** Return the lines of the question of a participant who asks for one's robot. `left_ms`: time that is left to answer. */
export function describeConsent(requester: string, robot: string, left_ms: number): string[] {
  return [...wrap(`${requester} asks you for ${robot}`), `point at an answer, press the trigger: ${Math.ceil(left_ms / 1000)} s`];
}

/** Return the lines beside a hand. `ignored`: what it holds that does not count before it is let go. */
export function describeHand(emulated: boolean, ignored: "squeeze" | "trigger" | null): string[] {
  if (emulated) return ["out of sight: its place is a guess", "bring it before the headset's cameras"];
  return ignored === null ? [] : [`let go, then ${ignored === "squeeze" ? "squeeze" : "press"} again`];
}

type OwnAlignment = ParticipantInfo["alignment"] | undefined;

/** Kinds of alignments that are good enough to look, not to drive. */
const VIEW_ONLY = ["fingertip", "persistent"];

/** Return whether an alignment says where the scene is in the room. */
export function isPlaced(alignment: OwnAlignment): boolean {
  return alignment != null && ["measured", "placed", ...VIEW_ONLY].includes(alignment.kind);
}

/** Return whether an alignment is good enough to look, not to drive. */
export function isViewOnly(alignment: OwnAlignment): boolean {
  return alignment != null && VIEW_ONLY.includes(alignment.kind);
}

/** Return the line about one's own alignment. */
export function describeAlignment(alignment: OwnAlignment): string {
  if (!alignment || !isPlaced(alignment)) return "not aligned";
  if (alignment.kind === "placed") return "placed by a director, error not measured";
  const error = alignment.error_at_robot_m > 0 ? ` ± ${formatMillimetres(alignment.error_at_robot_m)} at the robot` : "";
  if (alignment.offset) return "aligned, with an offset by hand";
  return `${isViewOnly(alignment) ? "to look, not to drive" : "aligned"}${error}`;
}

/** What a person has to know before anything else. */
export interface Urgent {
  isStopped: boolean;
  /** Who paused and why, empty: the session runs. */
  pause: string;
  /** Empty while the connection stands, else why it does not. */
  connection: string;
  isAligned: boolean;
  isTransparent: boolean;
  /** One may be placed by one's own word. */
  canPlace: boolean;
  /** The session has a sheet with marks to touch. */
  hasMarks: boolean;
  /** Why the alignment is unconfirmed, empty: it is not. */
  doubt: string;
  /** Advice of the session about the alignment. */
  advice: string;
  notice: string;
}

/** Return the lines before the eyes, none when all is well. */
export function describeUrgent({ isStopped, pause, connection, isAligned, isTransparent, canPlace, hasMarks, doubt, advice, notice }: Urgent): string[] {
  const lines: string[] = [];
  if (isStopped) lines.push("STOPPED: all robots hold");
  else if (pause !== "") lines.push(...wrap(pause), "robots stand still until a director resumes");
  if (connection !== "") lines.push(...wrap(connection));
  else if (!isAligned) {
    lines.push("This headset is not aligned");
    lines.push(
      ...wrap(
        isTransparent
          ? "The scene appears when the headset is aligned to the room, or when a director places it."
          : "The scene is at a place of this headset's own. Robots follow when a director places it.",
      ),
    );
    if (canPlace) lines.push(...wrap("To stay here: point at no robot, and press the trigger for a moment."));
    if (hasMarks) lines.push(...wrap("To touch the marks of a sheet, hold a trigger for two seconds, pointing at no robot."));
    if (advice !== "") lines.push(...wrap(advice));
  } else if (doubt !== "") {
    lines.push(...wrap(`${capitalize(doubt)}: robots hold at the next squeeze.`));
    lines.push(...wrap(hasMarks ? "Touch marks: hold a trigger for two seconds, pointing at no robot." : "Ask a director to place this headset again."));
  }
  if (notice !== "") lines.push(...wrap(notice));
  return lines;
}

export interface Pulse {
  /** 0 to 1. */
  intensity: number;
  duration_ms: number;
}

/** Contact force that is felt fully [N]. */
const FULL_N = 20;

/** Return what the hand feels when the feedback of its robot changes, null for nothing. */
export function findPulse(before: Filled<wire.Feedback> | undefined, now: Filled<wire.Feedback>): Pulse | null {
  if (now.contact_n > (before?.contact_n ?? 0)) return { intensity: Math.min(1, 0.2 + now.contact_n / FULL_N), duration_ms: 40 };
  const isRefused = now.hold_reason !== "" && now.hold_reason !== "clutch_open" && now.hold_reason !== before?.hold_reason;
  if (isRefused && before !== undefined) return { intensity: 0.8, duration_ms: 150 };
  if (now.limits.some((limit) => !before?.limits.includes(limit))) return { intensity: 0.4, duration_ms: 60 };
  return null;
}

/** Return how much of something is done, 0 to 1, as a bar. */
export function drawBar(share: number): string {
  return "▮".repeat(Math.ceil(10 * Math.min(1, share))).padEnd(10, "▯");
}

/** Return a text in lines. */
export function wrap(text: string): string[] {
  const lines: string[] = [];
  for (const word of text.split(/\s+/)) {
    const last = lines.at(-1);
    if (last !== undefined && last.length + 1 + word.length <= LINE) lines[lines.length - 1] = `${last} ${word}`;
    else lines.push(word);
  }
  return lines;
}
