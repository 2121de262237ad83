// What is asked of grippers. One that holds an object must not open because a squeeze begins: the trigger is let go then. So a
// gripper stays as it is until the trigger is closed at least as far as the gripper may be, and follows it from there.
using System;
using System.Collections.Generic;

namespace IrisSession.Interaction
{
    /// <summary>Of a robot that no other participant holds, too: changes when another may have moved its gripper since.</summary>
    public readonly struct Tenure : IEquatable<Tenure>
    {
        private readonly long leaseVersion;
        private readonly long sceneEpoch;

        public Tenure(long leaseVersion, long sceneEpoch)
        {
            this.leaseVersion = leaseVersion;
            this.sceneEpoch = sceneEpoch;
        }

        public bool Equals(Tenure other) { return leaseVersion == other.leaseVersion && sceneEpoch == other.sceneEpoch; }

        public override bool Equals(object other) { return other is Tenure value && Equals(value); }

        public override int GetHashCode() { return leaseVersion.GetHashCode() ^ (sceneEpoch.GetHashCode() * 397); }
    }

    /// <summary>Grippers of the robots that this participant holds. One that is not known may be closed.</summary>
    public sealed class Grips
    {
        /// <summary>A gripper opens at least this fast [1/s]; the session's default is four times that.</summary>
        private const double OpeningPerS = 1;

        /// <summary>A trigger that is this close to closed is closed.</summary>
        private const double Tolerance = 0.05;

        private sealed class Grip
        {
            public double Closed = 1; // at most
            public bool IsTaken; // it follows the trigger of the hand that squeezes
            public Tenure? Tenure;
        }

        private readonly Dictionary<string, Grip> grips = new Dictionary<string, Grip>();
        private readonly List<string> lost = new List<string>();

        /// <summary>Return what a trigger asks of the gripper during a squeeze, null: nothing.</summary>
        /// <param name="robot">Its name.</param>
        /// <param name="tenure">Null: others may move it at any time.</param>
        /// <param name="trigger">0 to 1.</param>
        /// <param name="isFollowing">The session moves the robot.</param>
        /// <param name="seconds">Since the frame before.</param>
        public double? Follow(string robot, Tenure? tenure, double trigger, bool isFollowing, double seconds)
        {
            bool isKnown = grips.TryGetValue(robot, out Grip grip) && Nullable.Equals(grip.Tenure, tenure);
            double closed = isKnown ? grip.Closed : 1;
            bool isTaken = isKnown && grip.IsTaken;
            if (!isFollowing && isTaken) grips.Remove(robot); // what it did with the last samples is not known
            if (!isFollowing || (!isTaken && trigger < closed - Tolerance)) return null;
            if (grip == null) grips[robot] = grip = new Grip();
            grip.Closed = Math.Max(trigger, closed - OpeningPerS * seconds);
            grip.IsTaken = true;
            grip.Tenure = tenure;
            return trigger;
        }

        /// <summary>The squeeze has ended.</summary>
        public void LetGo(string robot)
        {
            if (!grips.TryGetValue(robot, out Grip grip)) return;
            if (grip.Tenure == null) grips.Remove(robot);
            else grip.IsTaken = false;
        }

        /// <summary>Forget robots that are not held.</summary>
        public void KeepOnly(List<string> held)
        {
            lost.Clear();
            foreach (string robot in grips.Keys) if (!held.Contains(robot)) lost.Add(robot);
            foreach (string robot in lost) grips.Remove(robot);
        }
    }
}
