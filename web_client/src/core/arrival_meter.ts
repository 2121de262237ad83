// Report of a client about itself, once a second: ages and gaps of the state that it passed on.

import type * as wire from "../protocol/messages.g.ts";
import { readHeader, type SceneState } from "./state_stream.ts";

const PERIOD_NS = 1_000_000_000;
/** Most ages per period: more frames than are ever sent in a second. */
const MAX_AGES = 512;

/** Figures of one period. */
export interface Arrivals {
  ageMsP50: number;
  ageMsP99: number;
  delivered: number;
  missed: number;
  bytesPerS: number;
  mediaBytesPerS: number;
  mediaAgeMs: number;
  displayHz: number;
  /** Age of the picture: of what was drawn last, and the time between two frames; 0: nothing was drawn. */
  shownAgeMs: number;
}

/** Collects ages and gaps of the state, media and frames drawn. */
export class ArrivalMeter {
  private agesNs: number[] = [];
  private quantiles: readonly [number, number] = [0, 0];
  private shownNs = -1;
  private delivered = 0;
  private missed = 0;
  private seq = 0;
  private bytes = 0;
  private sinceNs = -1;
  private mediaBytes = 0;
  private mediaAgesNs: number[] = [];
  private drawn = 0;
  private drawnAgeMs = 0;

  /**
   * Record a state that was passed on.
   *
   * One that is sent again, because its source is silent, is as old as that silence: its age does not count. The first of a
   * connection may be one of those.
   */
  recordState(state: SceneState): void {
    const { stateSeq } = readHeader(state.header);
    if (this.seq > 0 && stateSeq > this.seq) this.missed += stateSeq - this.seq - 1;
    this.seq = stateSeq;
    this.delivered += 1;
    if (this.agesNs.length < MAX_AGES && this.shownNs !== -1 && this.shownNs !== state.sessionTime) this.agesNs.push(state.ageNs);
    this.shownNs = state.sessionTime;
  }

  /** Record a frame of media. */
  recordMedia(bytes: number, ageNs: number): void {
    this.mediaBytes += bytes;
    if (this.mediaAgesNs.length < MAX_AGES) this.mediaAgesNs.push(ageNs);
  }

  /** Record frames that the page drew. `ageMs`: of the state in them. */
  recordDrawn(frames: number, ageMs = 0): void {
    this.drawn += frames;
    this.drawnAgeMs = ageMs;
  }

  /** Begin anew, with another connection. */
  restart(): void {
    this.sinceNs = this.shownNs = -1;
    this.seq = 0;
    this.quantiles = [0, 0];
  }

  /** Return the figures of the last second when they are due, else null. `received`: bytes of state so far. */
  poll(received: number, nowNs: number): Arrivals | null {
    if (this.sinceNs < 0) {
      this.startPeriod(received, nowNs);
      return null;
    }
    const elapsedNs = nowNs - this.sinceNs;
    if (elapsedNs < PERIOD_NS) return null;
    if (this.agesNs.length > 0 || this.delivered === 0) this.quantiles = computeQuantilesMs(this.agesNs);
    const seconds = elapsedNs * 1e-9;
    const arrivals = {
      ageMsP50: this.quantiles[0],
      ageMsP99: this.quantiles[1],
      delivered: this.delivered,
      missed: this.missed,
      bytesPerS: (received - this.bytes) / seconds,
      mediaBytesPerS: this.mediaBytes / seconds,
      mediaAgeMs: computeQuantilesMs(this.mediaAgesNs)[0],
      displayHz: this.drawn / seconds,
      shownAgeMs: this.drawn > 0 && this.drawnAgeMs > 0 ? this.drawnAgeMs + (1000 * seconds) / this.drawn : 0,
    };
    this.startPeriod(received, nowNs);
    return arrivals;
  }

  private startPeriod(received: number, nowNs: number): void {
    this.sinceNs = nowNs;
    this.bytes = received;
    this.agesNs = [];
    this.mediaAgesNs = [];
    this.delivered = this.missed = this.mediaBytes = this.drawn = 0;
  }
}

/** Return the message that reports `arrivals`. */
export function makeReport(arrivals: Arrivals, rttNs: number): wire.ClientReport {
  return {
    type: "client_report",
    age_ms_p50: arrivals.ageMsP50,
    age_ms_p99: arrivals.ageMsP99,
    delivered: arrivals.delivered,
    missed: arrivals.missed,
    rtt_ms: rttNs * 1e-6,
    bytes_per_s: arrivals.bytesPerS,
    media_bytes_per_s: arrivals.mediaBytesPerS,
    media_age_ms: arrivals.mediaAgeMs,
    display_hz: arrivals.displayHz,
    shown_age_ms: arrivals.shownAgeMs,
  };
}

/** Return median and 99th percentile of durations [ns], in milliseconds; 0 without any. */
function computeQuantilesMs(durationsNs: readonly number[]): readonly [number, number] {
  const sorted = [...durationsNs].sort((a, b) => a - b);
  const last = sorted.length - 1;
  if (last < 0) return [0, 0];
  return [(sorted[last >> 1] as number) * 1e-6, (sorted[Math.ceil((last * 99) / 100)] as number) * 1e-6];
}
