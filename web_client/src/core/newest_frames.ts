// Frames of streams of which only the newest counts: at most one of each stream is under way, and one waits.

/** Passes frames on one by one: a newer one takes the place of one that waits. */
export class NewestFrames<T> {
  /** Streams with a frame under way, and what waits behind it. */
  private readonly underWay = new Map<string, T | null>();

  constructor(private readonly begin: (stream: string, frame: T) => void) {}

  /** Begin with a frame, or let it wait. Returns false when it took the place of another one. */
  push(stream: string, frame: T): boolean {
    const waiting = this.underWay.get(stream);
    this.underWay.set(stream, waiting === undefined ? null : frame);
    if (waiting === undefined) this.begin(stream, frame);
    return waiting === undefined || waiting === null;
  }

  /** Note that the frame under way is done, and begin with the one that waits. */
  finish(stream: string): void {
    const next = this.underWay.get(stream);
    if (next === undefined) return;
    if (next === null) {
      this.underWay.delete(stream);
      return;
    }
    this.underWay.set(stream, null);
    this.begin(stream, next);
  }

  /** Forget what waits, but for these streams. What is under way still ends. */
  keepOnly(streams: readonly string[]): void {
    for (const stream of this.underWay.keys()) if (!streams.includes(stream)) this.underWay.set(stream, null);
  }
}
