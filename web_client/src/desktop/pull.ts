// Handles at the gripper as one more input: the gripper goes to where they are dragged, and no farther. Pure.

import { type Heading, TURN_PER_METRE } from "./device.ts";
import { type Intent, limitLength, makeIdle, type Vec3 } from "./intent.ts";

/** The handles, as far as driving knows them. */
export interface Handles {
  /** A pointer holds them: the dead-man. */
  readonly isHeld: boolean;
  /** From a sample until its effect is seen [s]. */
  readonly lag_s: number;
  /** Set the way that the gripper has to go, in the session's world [m, rad]. */
  readWay(move: Vec3, turn: Vec3): void;
  letGo(): void;
}

/** Speed for a way, times the lag: 1/e is the most that does not go beyond the end and back. */
const DAMPED = Math.exp(-1);
/** A lag that is measured as less counts as this [s]: 2.5 m/s for a metre. */
const LEAST_LAG_S = 0.15;

/** The input of handles. */
export class Pull {
  private readonly move: Vec3 = [0, 0, 0];
  private readonly turn: Vec3 = [0, 0, 0];
  /** The present hold has been reported as open once: a pointer that comes down is the edge that a dead-man needs. */
  private isBegun = false;

  constructor(private readonly handles: Handles) {}

  letGo(): void {
    this.isBegun = false;
    this.handles.letGo();
  }

  /** Return what the handles ask for. `heading`: where "forward" is; `speed`: of the tip [m/s]. */
  read(heading: Heading, speed: number): Intent {
    const intent = makeIdle();
    const clutch = this.handles.isHeld && this.isBegun;
    this.isBegun = this.handles.isHeld;
    if (!clutch || speed <= 0) return intent;
    this.handles.readWay(this.move, this.turn);
    const gain = DAMPED / Math.max(LEAST_LAG_S, this.handles.lag_s);
    intent.clutch = true;
    intent.move = limitLength(toView(this.move, heading, gain / speed));
    intent.turn = limitLength(toView(this.turn, heading, gain / (speed * TURN_PER_METRE)));
    return intent;
  }
}

/** Return a vector of the world along the axes of an intent (right, forward, up), times `scale`. */
function toView([vx, vy, vz]: Vec3, [x, y]: Heading, scale: number): Vec3 {
  return [scale * (vx * y - vy * x), scale * (vx * x + vy * y), scale * vz];
}
