// What the engine's thread reads: the newest state, poses of others, and the session as a view that never changes.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>The newest state. Valid until the next one is taken.</summary>
    public sealed class StateFrame
    {
        /// <summary>Rows `x y z qw qx qy qz`, world frame, in the order of `SessionView.Bodies` of the same `BodiesVersion`.</summary>
        public double[] Poses = new double[0];

        /// <summary>Counts changes of the bodies: poses and bodies of other versions do not belong together.</summary>
        public long BodiesVersion;
        public long SceneEpoch;
        public long SceneRevision;
        public long StateSeq;
        public long Tick;
        public double SimTime;

        /// <summary>End of its tick, session time [ns].</summary>
        public long SessionTimeNs;

        /// <summary>Age when it was decoded [ns].</summary>
        public long AgeNs;

        /// <summary>Per robot, the newest sample behind the command in force: the first `AppliedCount` count.</summary>
        public Applied[] Applied = new Applied[0];
        public int AppliedCount;

        internal void Fill(StateStream stream, long bodiesVersion)
        {
            StateHeader header = stream.Header;
            double[] poses = stream.Poses;
            if (Poses.Length != poses.Length) Poses = new double[poses.Length];
            Array.Copy(poses, Poses, poses.Length);
            BodiesVersion = bodiesVersion;
            SceneEpoch = header.SceneEpoch;
            SceneRevision = header.SceneRevision;
            StateSeq = header.StateSeq;
            Tick = header.Tick;
            SimTime = header.SimTime;
            SessionTimeNs = header.SessionTime;
            AgeNs = stream.AgeNs;
            AppliedCount = header.Applied.Length;
            if (Applied.Length < AppliedCount)
            {
                int before = Applied.Length;
                Array.Resize(ref Applied, AppliedCount);
                for (int i = before; i < AppliedCount; i++) Applied[i] = new Applied();
            }
            for (int i = 0; i < AppliedCount; i++) Copy(header.Applied[i], Applied[i]);
        }

        private static void Copy(Applied from, Applied to)
        {
            to.Robot = from.Robot;
            to.Participant = from.Participant;
            to.Device = from.Device;
            to.Seq = from.Seq;
            to.CaptureNs = from.CaptureNs;
            to.ReceiveNs = from.ReceiveNs;
            to.StepNs = from.StepNs;
        }
    }

    /// <summary>Poses of the other participants. Valid until the next ones are taken.</summary>
    public sealed class PresenceFrame
    {
        /// <summary>The first `Count` count.</summary>
        public PresenceItem[] Items = new PresenceItem[0];
        public int Count;
        public long SessionTimeNs;

        internal void Fill(PresenceTable table)
        {
            IReadOnlyList<PresenceItem> items = table.ListItems();
            SessionTimeNs = table.SessionTimeNs;
            Count = items.Count;
            if (Items.Length < Count)
            {
                int before = Items.Length;
                Array.Resize(ref Items, Count + 8);
                for (int i = before; i < Items.Length; i++) Items[i] = new PresenceItem();
            }
            for (int i = 0; i < Count; i++)
            {
                PresenceItem from = items[i];
                PresenceItem to = Items[i];
                to.Participant = from.Participant;
                to.Device = from.Device;
                to.CaptureNs = from.CaptureNs;
                Array.Copy(from.Pose.P, to.Pose.P, 3);
                Array.Copy(from.Pose.Q, to.Pose.Q, 4);
            }
        }
    }

    /// <summary>The session as it was at one moment. Never changes: another one replaces it. Its parts must not be changed.</summary>
    public sealed class SessionView
    {
        public readonly ConnectionPhase Phase;

        /// <summary>One line for people: why there is no connection, or "connected".</summary>
        public readonly string Text;

        /// <summary>Why the session does not let us in, null while it may.</summary>
        public readonly Refused Failure;

        /// <summary>What is in the way of a connection until the person has decided: see <see cref="SessionLoop.Problem"/>.</summary>
        public readonly LinkEnd Problem;

        /// <summary>Address in use or tried now, null for none.</summary>
        public readonly WebEndpoint Endpoint;

        /// <summary>True while the session has stopped stepping.</summary>
        public readonly bool IsStalled;
        public readonly Welcome Welcome;
        public readonly string ParticipantId;

        /// <summary>False before the first snapshot and after a gap: what follows is the last known.</summary>
        public readonly bool IsSynced;
        public readonly long EventSeq;
        public readonly long SceneEpoch;
        public readonly long SceneRevision;
        public readonly string SceneHash;
        public readonly long TickPeriodNs;

        /// <summary>Time to answer a question of consent, 0 where the session does not state it.</summary>
        public readonly long ConsentTimeoutNs;
        public readonly bool IsPaused;
        public readonly bool IsStopped;
        public readonly long StopSeq;
        public readonly EpisodeChanged Episode;
        public readonly long BodiesVersion;
        public readonly BodyInfo[] Bodies;
        public readonly IReadOnlyDictionary<string, ParticipantInfo> Participants;
        public readonly IReadOnlyDictionary<string, Lease> Leases;
        public readonly IReadOnlyDictionary<string, RobotInfo> Robots;
        public readonly IReadOnlyDictionary<string, AnchorInfo> Anchors;

        /// <summary>Our own alignment in the present tracking frame, null for none; and what a person has to know of it.</summary>
        public readonly Alignment Alignment;
        public readonly AlignmentState AlignmentState;
        public readonly DeliveryBudget Budget;

        internal SessionView(SessionLoop loop, SessionView before)
        {
            ClientConnection connection = loop.Connection;
            SessionMirror mirror = connection.Mirror;
            Phase = connection.Phase;
            Text = loop.Problem.Failure == LinkFailure.None ? connection.Describe() : loop.Problem.Text;
            Failure = connection.Failure;
            Problem = loop.Problem;
            Endpoint = loop.Endpoints.Current;
            IsStalled = connection.IsStalled;
            Welcome = connection.Welcome;
            ParticipantId = connection.ParticipantId;
            IsSynced = mirror.IsSynced;
            EventSeq = mirror.EventSeq;
            SceneEpoch = mirror.SceneEpoch;
            SceneRevision = mirror.SceneRevision;
            SceneHash = mirror.SceneHash;
            TickPeriodNs = mirror.TickPeriodNs;
            ConsentTimeoutNs = mirror.ConsentTimeoutNs;
            IsPaused = mirror.IsPaused;
            IsStopped = mirror.IsStopped;
            StopSeq = mirror.StopSeq;
            Episode = mirror.Episode;
            bool isSame = before != null && HasSameBodies(mirror.Bodies, before.Bodies);
            Bodies = isSame ? before.Bodies : mirror.Bodies.ToArray();
            BodiesVersion = before == null ? 1 : before.BodiesVersion + (isSame ? 0 : 1);
            Participants = new Dictionary<string, ParticipantInfo>(mirror.Participants);
            Leases = new Dictionary<string, Lease>(mirror.Leases);
            Robots = new Dictionary<string, RobotInfo>(mirror.Robots);
            Anchors = new Dictionary<string, AnchorInfo>(mirror.Anchors);
            Alignment = loop.Alignment.Current;
            AlignmentState = loop.Alignment.State;
            Budget = connection.Budget;
        }

        /// <summary>True while the session has accepted us and the connection stands as far as we know.</summary>
        public bool IsJoined { get { return Phase == ConnectionPhase.Syncing || Phase == ConnectionPhase.Ready; } }

        /// <summary>Return whether we hold the lease of a robot or object.</summary>
        public bool IsOurs(string target)
        {
            return Leases.TryGetValue(target, out Lease lease) && SessionMirror.IsHeldBy(lease, ParticipantId);
        }

        private static bool HasSameBodies(List<BodyInfo> a, BodyInfo[] b)
        {
            if (a.Count != b.Length) return false;
            for (int i = 0; i < b.Length; i++)
            {
                if (a[i] != b[i] && (a[i].Id != b[i].Id || a[i].Name != b[i].Name || a[i].Moving != b[i].Moving || a[i].Object != b[i].Object)) return false;
            }
            return true;
        }
    }

    /// <summary>What <see cref="SessionNews"/> is about.</summary>
    public enum NewsKind
    {
        /// <summary>An event, feedback, fault or denial; or events that are missed.</summary>
        Message,

        /// <summary>The answer to a request, null when the connection was lost before it came.</summary>
        Reply,

        /// <summary>Words for the person, of the gateway or about a call that could not be done.</summary>
        Notice,

        /// <summary>Something happened to the headset itself: `Headset`.</summary>
        Headset,
    }

    /// <summary>Something that happened, in order.</summary>
    public struct SessionNews
    {
        public NewsKind Kind;
        public InboxMessage Message;

        /// <summary>Of a reply: what <see cref="SessionClient.Request"/> returned.</summary>
        public long Ticket;
        public Reply Reply;
        public HeadsetEvent Headset;
        public string Text;
    }
}
