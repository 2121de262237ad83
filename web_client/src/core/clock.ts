// Estimate of session time from four-timestamp exchanges. Pure: the caller passes its own monotonic clock in.
//
// Each exchange gives an offset `((t1 - t0) + (t2 - t3)) / 2` whose error is at most half its round trip, for any
// asymmetry of the path, plus drift since. The estimate is the median offset of the quickest quarter of a window, kept
// within the intersection of those intervals (Marzullo), which is also the stated error bound. After the first exchange it
// is slewed, so that session time does not run backwards. It is stepped only when the exchanges prove it impossible, as
// after sleep of the machine, during which its clock stood still.
//
// All times are whole nanoseconds.

/** Exchanges; a quarter of a minute at two per second. */
const WINDOW = 32;
/** Older exchanges no longer count. */
const MAX_AGE_NS = 60_000_000_000;
/** Exchanges before the estimate is used: a single one may have been delayed by a busy machine. */
const SETTLED = 4;
/** The estimate moves by 10 ms per second: invisible in 150 ms freshness, monotonic. */
const SLEW = 0.01;
/** Samples from further in the future are rejected, so larger corrections are slewed by 100 ms per second. */
const LARGE_NS = 5_000_000;
const SLEW_LARGE = 0.1;
/** Two quartz clocks of +-50 ppm each. */
const DRIFT = 100e-6;
/** Exchanges in a row that contradict all earlier ones: the local clock has jumped. */
const JUMP = 4;
/** Exchanges at the start and after a reset, at the shorter period, then at the longer one. */
const BURST = 8;
const BURST_PERIOD_NS = 5_000_000;
const PERIOD_NS = 500_000_000;

interface Exchange {
  atNs: number;
  offsetNs: number;
  rttNs: number;
}

/** Maps the client's monotonic clock to session time. */
export class ClockSync {
  rejected = 0;
  private target = 0;
  private offset = 0;
  private offsetAt = 0;
  private rtt = 0;
  // No exchange agrees with this interval, so the first one is taken as it is.
  private low = Number.POSITIVE_INFINITY;
  private high = Number.NEGATIVE_INFINITY;
  private window: Exchange[] = [];
  private contradicting: Exchange[] = [];
  private nextPing = 0;
  private sent = 0;

  /** Clear everything, for another session. */
  reset(): void {
    this.target = this.offset = this.offsetAt = this.rtt = 0;
    this.low = Number.POSITIVE_INFINITY;
    this.high = Number.NEGATIVE_INFINITY;
    this.restart();
  }

  /** Measure again after a new connection to the session: the machine may have slept. */
  restart(): void {
    this.window = [];
    this.contradicting = [];
    this.nextPing = 0;
    this.sent = 0;
  }

  /** True after the first exchange. */
  get synced(): boolean {
    return this.window.length > 0;
  }

  /** True when there were enough exchanges to stamp samples. */
  get settled(): boolean {
    return this.window.length >= SETTLED;
  }

  /** Shortest round trip in the window [ns], 0 before the first exchange. */
  get rttNs(): number {
    return this.rtt;
  }

  /** Time at which the next ping is due [local ns]. */
  get nextPingNs(): number {
    return this.nextPing;
  }

  /** Return whether a `clock_ping` is to be sent now, and count it as sent. */
  pollPing(localNs: number): boolean {
    if (localNs < this.nextPing) return false;
    this.sent += 1;
    this.nextPing = localNs + (this.sent < BURST ? BURST_PERIOD_NS : PERIOD_NS);
    return true;
  }

  /** Count one exchange: `t0`, `t3` on the client's clock, `t1`, `t2` in session time. Impossible ones are rejected. */
  processPong(t0Ns: number, t1Ns: number, t2Ns: number, t3Ns: number): void {
    const rttNs = t3Ns - t0Ns - (t2Ns - t1Ns);
    if (t3Ns < t0Ns || t2Ns < t1Ns || rttNs < 0) {
      this.rejected += 1;
      return;
    }
    const exchange = { atNs: t3Ns, offsetNs: Math.floor((t1Ns - t0Ns + (t2Ns - t3Ns)) / 2), rttNs };
    let jumped = false;
    if (this.synced && this.contradicts(exchange)) {
      this.contradicting.push(exchange);
      if (this.contradicting.length < JUMP) {
        this.sent = 0; // another burst
        this.nextPing = Math.min(this.nextPing, t3Ns);
        return;
      }
      this.window = this.contradicting.slice(0, -1);
      jumped = true;
    } else {
      jumped = !this.synced && this.contradicts(exchange);
    }
    this.contradicting = [];
    this.window.push(exchange);
    if (this.window.length > WINDOW) this.window.shift();
    this.estimate(t3Ns, jumped);
  }

  /** Return session time [ns] at `localNs`. Meaningless before `synced`. */
  sessionNs(localNs: number): number {
    return localNs + this.slewedOffset(localNs);
  }

  /** Return the client's clock at session time `sessionNs`, by the present estimate. */
  localNs(sessionNs: number): number {
    return sessionNs - this.target;
  }

  /** Return the bound of the error of `sessionNs(localNs)` [ns]: round trips, drift, and remaining slew. */
  errorBoundNs(localNs: number): number {
    const offset = this.slewedOffset(localNs);
    let { low, high } = this;
    for (const exchange of this.contradicting) {
      const reach = uncertainty(exchange, localNs); // these may be right
      low = Math.min(low, exchange.offsetNs - reach);
      high = Math.max(high, exchange.offsetNs + reach);
    }
    return Math.max(high - offset, offset - low) + Math.trunc(DRIFT * Math.abs(localNs - this.offsetAt));
  }

  /** Return whether this exchange and the estimate cannot both be right. */
  private contradicts(exchange: Exchange): boolean {
    const reach = uncertainty(exchange, exchange.atNs) + Math.trunc(DRIFT * (exchange.atNs - this.offsetAt));
    return exchange.offsetNs + reach < this.low || exchange.offsetNs - reach > this.high;
  }

  private estimate(nowNs: number, jumped: boolean): void {
    const offset = this.slewedOffset(nowNs);
    const fresh = this.window.filter((exchange) => nowNs - exchange.atNs <= MAX_AGE_NS).sort((a, b) => a.rttNs - b.rttNs);
    const quickest = fresh.slice(0, Math.max(1, Math.floor(fresh.length / 4)));
    [this.low, this.high] = intersect(fresh, nowNs);
    const middle = Math.trunc(median(quickest.map((exchange) => exchange.offsetNs)));
    this.target = Math.max(this.low, Math.min(this.high, middle));
    this.rtt = (quickest[0] as Exchange).rttNs;
    this.offset = jumped ? this.target : offset;
    this.offsetAt = nowNs;
  }

  private slewedOffset(localNs: number): number {
    const elapsed = Math.max(0, localNs - this.offsetAt);
    const way = this.target - this.offset;
    const quick = Math.min(elapsed, Math.max(0, Math.abs(way) - LARGE_NS) / SLEW_LARGE); // nanoseconds of quick movement
    const room = Math.trunc(SLEW_LARGE * quick + SLEW * (elapsed - quick));
    return this.offset + Math.max(-room, Math.min(room, way));
  }
}

/** Return how far the offset can be from that of an exchange [ns]. */
function uncertainty(exchange: Exchange, nowNs: number): number {
  return Math.floor(exchange.rttNs / 2) + Math.trunc(DRIFT * (nowNs - exchange.atNs)) + 1;
}

/** Return the lowest and highest offset that agree with the exchanges, quickest first, without contradicting ones. */
function intersect(exchanges: readonly Exchange[], nowNs: number): [number, number] {
  let low = Number.NEGATIVE_INFINITY;
  let high = Number.POSITIVE_INFINITY;
  for (const exchange of exchanges) {
    const reach = uncertainty(exchange, nowNs);
    if (exchange.offsetNs - reach > high || exchange.offsetNs + reach < low) continue;
    low = Math.max(low, exchange.offsetNs - reach);
    high = Math.min(high, exchange.offsetNs + reach);
  }
  return [low, high];
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  const middle = sorted.length >> 1;
  return sorted.length % 2 === 1 ? (sorted[middle] as number) : ((sorted[middle - 1] as number) + (sorted[middle] as number)) / 2;
}
