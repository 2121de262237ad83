// When shadows are drawn anew: after something moved, and no more often than the device can.

import type { WebGLRenderer } from "three";

/** Shadows of a scene. They change when something moves, not with the view. */
export class Shadows {
  private isOld = true;
  private last_ms = Number.NEGATIVE_INFINITY;

  /** `period_ms`: shortest time between two. */
  constructor(
    private readonly map: Pick<WebGLRenderer["shadowMap"], "autoUpdate" | "needsUpdate">,
    private readonly period_ms: number,
  ) {
    map.autoUpdate = false;
  }

  /** Something has moved, or is new. */
  markOld(): void {
    this.isOld = true;
  }

  /** Let the next frame draw shadows, if it is time. Returns whether a frame is needed for them, this one or a later one. */
  renew(now_ms: number): boolean {
    if (!this.isOld) return false;
    if (now_ms - this.last_ms < this.period_ms) return true;
    this.map.needsUpdate = true;
    this.last_ms = now_ms;
    this.isOld = false;
    return true;
  }
}
