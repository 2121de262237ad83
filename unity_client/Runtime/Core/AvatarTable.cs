// The other participants as they are drawn: which of their devices, where, in which colour. Poses are interpolated as those of bodies.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>A head, hand or controller of another participant.</summary>
    public sealed class Avatar
    {
        public readonly string Participant;
        public readonly string Device;

        /// <summary>True for a head, false for a hand or a controller.</summary>
        public readonly bool IsHead;
        internal readonly PoseBuffer Buffer;
        private readonly double[] frame = new double[7];
        private readonly double[] shown = new double[7];

        internal Avatar(string participant, string device, long delayNs)
        {
            Participant = participant;
            Device = device;
            IsHead = device == Protocol.Device.Head;
            Buffer = new PoseBuffer(delayNs, 8);
        }

        /// <summary>Pose in the world, of a frame with x forward, y left, z up.</summary>
        public RigidTransform T_world_device { get; private set; } = RigidTransform.Identity;

        internal long NewestNs { get; private set; } = long.MinValue;

        internal void Add(PresenceItem item, long atNs)
        {
            if (atNs <= NewestNs) return;
            NewestNs = atNs;
            Array.Copy(item.Pose.P, frame, 3);
            Array.Copy(item.Pose.Q, 0, frame, 3, 4);
            Buffer.Add(atNs, frame);
        }

        internal bool Show(long nowNs)
        {
            if (!Buffer.TryGetPoses(nowNs, shown, out _)) return false;
            T_world_device = RigidTransform.FromRow(shown, 0);
            return true;
        }
    }

    /// <summary>Avatars of one session. Frames without news allocate nothing.</summary>
    public sealed class AvatarTable
    {
        /// <summary>A device that reported nothing for this long is not drawn any more [ns].</summary>
        public const long StaleNs = 1_500_000_000;

        /// <summary>Avatars that are drawn at most: ten people with head and hands. Each is a draw call.</summary>
        public const int MaxAvatars = 30;

        /// <summary>Colours of participants, 0xRRGGBB, distinguishable with common colour blindness (Okabe and Ito 2008).</summary>
        private static readonly int[] Colors = { 0x3d9be9, 0xe69f00, 0x00b388, 0xd673ab, 0xf0e442, 0x56b4e9, 0xd55e00 };
        private const int UnknownColor = 0x8a93a3;
        private readonly List<Avatar> avatars = new List<Avatar>();
        private readonly List<Avatar> removed = new List<Avatar>();
        private readonly long delayNs;
        private readonly int most;

        /// <param name="most">Avatars that are drawn at most.</param>
        public AvatarTable(long delayNs = 33_000_000, int most = MaxAvatars)
        {
            this.delayNs = delayNs;
            this.most = most;
        }

        /// <summary>Avatars beyond those that were not drawn.</summary>
        public long Dropped { get; private set; }

        public IReadOnlyList<Avatar> Avatars { get { return avatars; } }

        /// <summary>Return the colour of a participant, by the number in its id: it never changes, and all clients show the same.</summary>
        public static int FindColor(string participant)
        {
            int at = participant.Length;
            while (at > 0 && participant[at - 1] >= '0' && participant[at - 1] <= '9') at--;
            if (at == participant.Length || participant.Length - at > 9) return UnknownColor;
            int number = int.Parse(participant.Substring(at), System.Globalization.CultureInfo.InvariantCulture);
            return Colors[(number + Colors.Length - 1) % Colors.Length];
        }

        /// <summary>Take the newest presence.</summary>
        /// <param name="items">The first `count` count, poses in the world frame.</param>
        /// <param name="count">Number of items.</param>
        /// <param name="sessionTimeNs">Session time of the message [ns].</param>
        /// <param name="self">Our own id: our devices are not drawn, they are where they are.</param>
        public void Add(IReadOnlyList<PresenceItem> items, int count, long sessionTimeNs, string self)
        {
            for (int i = 0; i < count; i++)
            {
                PresenceItem item = items[i];
                if (item.Participant == self || !IsDrawn(item.Device) || !IsFinite(item.Pose)) continue;
                Avatar avatar = Find(item.Participant, item.Device);
                if (avatar == null && avatars.Count == most)
                {
                    Dropped++;
                    continue;
                }
                if (avatar == null) avatars.Add(avatar = new Avatar(item.Participant, item.Device, delayNs));
                avatar.Add(item, item.CaptureNs > 0 ? item.CaptureNs : sessionTimeNs);
            }
        }

        /// <summary>Move avatars to where they were; returns those that went, which are not in the list any more.</summary>
        public IReadOnlyList<Avatar> Show(long nowNs, IReadOnlyDictionary<string, ParticipantInfo> participants)
        {
            removed.Clear();
            for (int i = avatars.Count - 1; i >= 0; i--)
            {
                Avatar avatar = avatars[i];
                bool isHere = participants.TryGetValue(avatar.Participant, out ParticipantInfo info) && info.Connected;
                // What is far ahead is of a session before, whose clock was another one.
                if (isHere && Math.Abs(nowNs - avatar.NewestNs) <= StaleNs && avatar.Show(nowNs)) continue;
                removed.Add(avatar);
                avatars.RemoveAt(i);
            }
            return removed;
        }

        /// <summary>Devices of other kinds than heads, hands and controllers have no place in the room.</summary>
        private static bool IsDrawn(string device)
        {
            return device == Protocol.Device.Head || device.StartsWith("hand/", StringComparison.Ordinal) || device.StartsWith("controller/", StringComparison.Ordinal);
        }

        private static bool IsFinite(Pose pose)
        {
            double sum = pose.P[0] + pose.P[1] + pose.P[2] + pose.Q[0] + pose.Q[1] + pose.Q[2] + pose.Q[3];
            return !double.IsNaN(sum) && !double.IsInfinity(sum);
        }

        private Avatar Find(string participant, string device)
        {
            foreach (Avatar one in avatars) if (one.Device == device && one.Participant == participant) return one;
            return null;
        }
    }
}
