// What is asked of grippers. One that holds an object must not open because a squeeze begins: the trigger is let go then. So
// a gripper stays as it is until the trigger is closed at least as far as the gripper may be, and follows it from there. Pure.

/** A gripper opens at least this fast [1/s]; the session's default is four times that. */
const OPENING_PER_S = 1;
/** A trigger that is this close to closed is closed. */
const TOLERANCE = 0.05;

interface Grip {
  /** How far it is closed at most. */
  closed: number;
  /** It follows the trigger of the hand that squeezes. */
  isTaken: boolean;
  tenure: string | undefined;
}

/** Grippers of the robots that this participant holds. One that is not known may be closed. */
export class Grips {
  private readonly grips = new Map<string, Grip>();

  /**
   * Return what a trigger asks of the gripper during a squeeze, null: nothing.
   *
   * `tenure`: changes when another may have moved the gripper since; undefined: others may at any time. `isFollowing`: the
   * session moves the robot.
   */
  follow(robot: string, tenure: string | undefined, trigger: number, isFollowing: boolean, dt_s: number): number | null {
    const known = this.grips.get(robot);
    const { closed, isTaken } = known && known.tenure === tenure ? known : { closed: 1, isTaken: false };
    if (!isFollowing && isTaken) this.grips.delete(robot); // what it did with the last samples is not known
    if (!isFollowing || (!isTaken && trigger < closed - TOLERANCE)) return null;
    this.grips.set(robot, { closed: Math.max(trigger, closed - OPENING_PER_S * dt_s), isTaken: true, tenure });
    return trigger;
  }

  /** The squeeze has ended. */
  letGo(robot: string): void {
    const grip = this.grips.get(robot);
    if (grip?.tenure === undefined) this.grips.delete(robot);
    else grip.isTaken = false;
  }

  /** Forget robots that are not held. */
  keepOnly(held: readonly string[]): void {
    for (const robot of this.grips.keys()) if (!held.includes(robot)) this.grips.delete(robot);
  }
}
