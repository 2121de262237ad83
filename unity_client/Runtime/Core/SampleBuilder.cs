// Samples with the numbers that fence them: epochs, versions, fencing tokens and `seq`.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>What the runtime of the headset knows of a pose, by the flags of the device's own pose.</summary>
    public enum PoseValidity
    {
        /// <summary>Out of sight: no pose, or one that is remembered.</summary>
        NotSeen,

        /// <summary>The position is an estimate (OpenXR: valid, but not tracked): it drives nothing.</summary>
        Emulated,

        /// <summary>Position and orientation are measured.</summary>
        Measured,
    }

    /// <summary>Input of one device at one moment. Made once and filled again.</summary>
    public sealed class SampleInput
    {
        /// <summary>A `Device`.</summary>
        public string Device = "";

        /// <summary>Session time at which the pose was sampled, not when it will be displayed [ns].</summary>
        public long CaptureNs;

        /// <summary>`T_tracking_device`, in the axes of the wire.</summary>
        public RigidTransform Pose;

        /// <summary>Whether `Pose` counts; a device of joints has none.</summary>
        public bool HasPose = true;
        public PoseValidity Validity = PoseValidity.Measured;

        /// <summary>Robots and objects to drive.</summary>
        public readonly List<string> Robots = new List<string>();
        public readonly List<string> Objects = new List<string>();

        /// <summary>True while the person wants the target to follow.</summary>
        public bool Clutch;

        /// <summary>0 open to 1 closed, null for none.</summary>
        public double? Gripper;

        /// <summary>Bit for each button that is pressed: docs/protocol.md, section 6.</summary>
        public long Buttons;

        /// <summary>(vx, vy, vz [m/s], wx, wy, wz [rad/s]) in the tracking frame, null for none.</summary>
        public double[] Twist;

        /// <summary>Poses `T_tracking_joint` as rows `x y z qw qx qy qz`; empty in most samples.</summary>
        public double[] HandJoints = new double[0];

        /// <summary>Joint positions of a leader [rad or m], and velocities.</summary>
        public double[] Q = new double[0];
        public double[] Qd = new double[0];

        /// <summary>A `SampleKind`, empty: by what is there.</summary>
        public string Kind = "";
    }

    /// <summary>Makes samples of one connection. `seq` counts per device, over all connections.</summary>
    public sealed class SampleBuilder
    {
        /// <summary>Targets of a sample.</summary>
        private const int MaxTargets = 8;

        /// <summary>Samples that are filled again, by device, with arrays of targets by their number.</summary>
        private sealed class Slot
        {
            public readonly Sample Sample = new Sample();
            public readonly Pose Pose = new Pose();
            public readonly Target[][] Targets = new Target[MaxTargets + 1][];
        }

        private readonly ClientConnection connection;
        private readonly Dictionary<string, Slot> slots = new Dictionary<string, Slot>();
        private readonly string[] names = new string[MaxTargets];
        private readonly string[] kinds = new string[MaxTargets];
        private readonly long[] tokens = new long[MaxTargets];
        private int found;

        public SampleBuilder(ClientConnection connection)
        {
            this.connection = connection;
        }

        /// <summary>
        /// Return a sample of the input, which is valid until the next one of this device. Allocates only for a device that is new.
        ///
        /// Robots and objects that are not ours are left out and counted.
        /// </summary>
        /// <exception cref="InvalidMessageException">The session has no such robot or object, or there are too many.</exception>
        public Sample MakeSample(SampleInput input)
        {
            found = 0;
            FindHeld(input.Robots, TargetKind.Robot);
            FindHeld(input.Objects, TargetKind.Object);
            if (!slots.TryGetValue(input.Device, out Slot slot)) slots[input.Device] = slot = new Slot();
            Sample sample = slot.Sample;
            Alignment alignment = connection.Mirror.FindAlignment(connection.ParticipantId);
            sample.Device = input.Device;
            sample.Kind = input.Kind.Length > 0 ? input.Kind : input.Q.Length > 0 ? SampleKind.Joints : input.Twist != null ? SampleKind.Twist : SampleKind.Pose;
            sample.Seq++;
            sample.CaptureNs = input.CaptureNs;
            sample.SceneEpoch = connection.Mirror.SceneEpoch;
            sample.TrackingEpoch = connection.TrackingEpoch;
            sample.AlignmentVersion = alignment == null ? 0 : alignment.Version;
            sample.Targets = FillTargets(slot);
            sample.Tracked = input.Validity != PoseValidity.NotSeen;
            sample.Emulated = input.Validity == PoseValidity.Emulated;
            sample.Worn = connection.IsWorn;
            sample.Clutch = input.Clutch;
            sample.Gripper = input.Gripper;
            sample.Buttons = input.Buttons;
            sample.Pose = input.HasPose ? slot.Pose : null;
            WritePose(input.Pose, slot.Pose);
            sample.Twist = input.Twist;
            sample.HandJoints = input.HandJoints;
            sample.Q = input.Q;
            sample.Qd = input.Qd;
            return sample;
        }

        /// <summary>Write a pose in the form of messages.</summary>
        public static void WritePose(RigidTransform pose, Pose target)
        {
            target.P[0] = pose.Position.X;
            target.P[1] = pose.Position.Y;
            target.P[2] = pose.Position.Z;
            target.Q[0] = pose.Rotation.W;
            target.Q[1] = pose.Rotation.X;
            target.Q[2] = pose.Rotation.Y;
            target.Q[3] = pose.Rotation.Z;
        }

        private void FindHeld(List<string> wanted, string kind)
        {
            for (int i = 0; i < wanted.Count; i++)
            {
                long token = connection.FindLeaseVersion(wanted[i]);
                if (token < 0)
                {
                    CheckKnown(wanted[i], kind);
                    connection.Counters.SamplesWithoutLease++;
                    continue;
                }
                if (found == MaxTargets) throw new InvalidMessageException("a sample drives at most " + MaxTargets + " targets");
                names[found] = wanted[i];
                kinds[found] = kind;
                tokens[found++] = token;
            }
        }

        /// <summary>Throw when the session does not have `name`; before the first snapshot everything may be there.</summary>
        private void CheckKnown(string name, string kind)
        {
            SessionMirror mirror = connection.Mirror;
            if (kind == TargetKind.Robot)
            {
                if (mirror.Robots.Count == 0 || mirror.Robots.ContainsKey(name)) return;
                throw new InvalidMessageException("no robot \"" + name + "\" in this session, it has: " + string.Join(", ", mirror.Robots.Keys));
            }
            bool hasObjects = false;
            foreach (BodyInfo body in mirror.Bodies)
            {
                hasObjects |= body.Object;
                if (body.Object && body.Name == name) return;
            }
            if (mirror.Leases.TryGetValue(name, out Lease lease) && lease.Kind == kind) return;
            if (hasObjects) throw new InvalidMessageException("no object \"" + name + "\" in this session");
        }

        private Target[] FillTargets(Slot slot)
        {
            Target[] targets = slot.Targets[found];
            if (targets == null)
            {
                slot.Targets[found] = targets = new Target[found];
                for (int i = 0; i < found; i++) targets[i] = new Target();
            }
            for (int i = 0; i < found; i++)
            {
                targets[i].Name = names[i];
                targets[i].LeaseVersion = tokens[i];
                targets[i].Kind = kinds[i];
            }
            return targets;
        }
    }
}
