// The shared session state, rebuilt from one snapshot and the events after it. Pure.
//
// The mirror never guesses: after a gap in `event_seq` it is not synced, and until a new snapshot comes it keeps the newer events
// aside (bounded). Two mirrors with equal `EventSeq` have equal `Hash()`, whenever they started.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>
    /// Roster, leases, alignments, robots, anchors and bodies of the session.
    ///
    /// While it is not synced, its fields show the last known state.
    /// </summary>
    public sealed class SessionMirror
    {
        /// <summary>Held while a snapshot is on its way; the next snapshot covers any further ones.</summary>
        private const int MaxHeldEvents = 256;

        public readonly Dictionary<string, ParticipantInfo> Participants = new Dictionary<string, ParticipantInfo>();
        public readonly Dictionary<string, Lease> Leases = new Dictionary<string, Lease>();
        public readonly Dictionary<string, RobotInfo> Robots = new Dictionary<string, RobotInfo>();
        public readonly Dictionary<string, AnchorInfo> Anchors = new Dictionary<string, AnchorInfo>();

        /// <summary>Bodies in the order of the rows of state frames, of the epochs from `BodiesSince` to `BodiesUntil`.</summary>
        public readonly List<BodyInfo> Bodies = new List<BodyInfo>();

        /// <summary>Row of a body in state frames, by its name.</summary>
        public readonly Dictionary<string, int> BodyIndex = new Dictionary<string, int>();

        /// <summary>Row of a body in state frames, by its id.</summary>
        public readonly Dictionary<long, int> IndexOfId = new Dictionary<long, int>();
        private readonly List<Event> held = new List<Event>();
        private bool hasSnapshot;

        /// <summary>False before the first snapshot and after a gap.</summary>
        public bool IsSynced { get; internal set; }

        public long EventSeq { get; private set; }

        public long SceneEpoch { get; private set; }

        public long SceneRevision { get; private set; }

        /// <summary>Address of the scene's specification, empty if none is shared.</summary>
        public string SceneHash { get; private set; } = "";

        public long TickPeriodNs { get; private set; }

        public bool IsPaused { get; private set; }

        public bool IsStopped { get; private set; }

        /// <summary>Number of the newest stop: `clear_estop` names it.</summary>
        public long StopSeq { get; private set; }

        public long ConsentTimeoutNs { get; private set; }

        /// <summary>The episode, null before the first.</summary>
        public EpisodeChanged Episode { get; private set; }

        public long BodiesSince { get; private set; }

        public long BodiesUntil { get; private set; }

        /// <summary>Gaps in the events.</summary>
        public long Gaps { get; private set; }

        /// <summary>Events and snapshots that were older than what is known.</summary>
        public long Discarded { get; private set; }

        public long HeldOverflow { get; private set; }

        /// <summary>Clear the session, keep the counters.</summary>
        public void Reset()
        {
            Participants.Clear();
            Leases.Clear();
            Robots.Clear();
            Anchors.Clear();
            Bodies.Clear();
            BodyIndex.Clear();
            IndexOfId.Clear();
            held.Clear();
            hasSnapshot = IsSynced = IsPaused = IsStopped = false;
            EventSeq = SceneEpoch = SceneRevision = TickPeriodNs = StopSeq = ConsentTimeoutNs = BodiesSince = BodiesUntil = 0;
            SceneHash = "";
            Episode = null;
        }

        /// <summary>Return the alignment of one participant, null while it has none.</summary>
        public Alignment FindAlignment(string participant)
        {
            return Participants.TryGetValue(participant, out ParticipantInfo info) ? info.Alignment : null;
        }

        /// <summary>Return the fencing token of `target` when `participant` holds it (alone or with others), else -1.</summary>
        public long FindLeaseVersion(string target, string participant)
        {
            return Leases.TryGetValue(target, out Lease lease) && IsHeldBy(lease, participant) ? lease.LeaseVersion : -1;
        }

        /// <summary>Return whether a participant holds a lease, alone or with others.</summary>
        public static bool IsHeldBy(Lease lease, string participant)
        {
            if (lease.Holder == participant) return true;
            foreach (string sharer in lease.SubHolders) if (sharer == participant) return true;
            return false;
        }

        /// <summary>
        /// Apply a snapshot and the held events after it. `applied` gets, in order, the events since the last one that was applied: each
        /// one that arrived, and ranges of those that did not. Events before the first snapshot are neither.
        /// </summary>
        internal void ApplySnapshot(Snapshot snapshot, List<InboxMessage> applied)
        {
            if (IsSynced && snapshot.EventSeq < EventSeq)
            {
                Discarded++;
                return;
            }
            SortedList<long, Event> waiting = new SortedList<long, Event>();
            foreach (Event one in held) waiting[one.EventSeq] = one;
            held.Clear();
            if (hasSnapshot) ListCoveredEvents(waiting.Values, snapshot.EventSeq, applied);
            if (applied.Count == 0) foreach (long seq in waiting.Keys) if (seq <= snapshot.EventSeq) Discarded++;
            TakeSnapshot(snapshot);
            foreach (Event one in waiting.Values)
            {
                if (one.EventSeq > snapshot.EventSeq && ApplyEvent(one)) applied.Add(new InboxMessage(one));
            }
        }

        /// <summary>Apply the next event. Returns false when it was discarded, or held until a snapshot comes.</summary>
        internal bool ApplyEvent(Event one)
        {
            if (!IsSynced)
            {
                HoldEvent(one);
                return false;
            }
            if (one.EventSeq <= EventSeq)
            {
                Discarded++;
                return false;
            }
            if (one.EventSeq != EventSeq + 1)
            {
                Gaps++;
                IsSynced = false;
                HoldEvent(one);
                return false;
            }
            EventSeq = one.EventSeq;
            ApplyBody(one.Body);
            return true;
        }

        private void TakeSnapshot(Snapshot snapshot)
        {
            EventSeq = snapshot.EventSeq;
            SceneEpoch = snapshot.SceneEpoch;
            SceneRevision = snapshot.SceneRevision;
            SceneHash = snapshot.SceneHash;
            TickPeriodNs = snapshot.TickPeriodNs;
            IsPaused = snapshot.Paused;
            IsStopped = snapshot.Estop;
            StopSeq = snapshot.StopSeq;
            ConsentTimeoutNs = snapshot.ConsentTimeoutNs;
            Episode = snapshot.Episode;
            Participants.Clear();
            foreach (ParticipantInfo info in snapshot.Participants) Participants[info.Id] = info;
            Leases.Clear();
            foreach (Lease lease in snapshot.Leases) Leases[lease.Target] = lease;
            Robots.Clear();
            foreach (RobotInfo robot in snapshot.Robots) Robots[robot.Name] = robot;
            Anchors.Clear();
            foreach (AnchorInfo anchor in snapshot.Anchors) Anchors[anchor.Id] = anchor;
            TakeBodies(snapshot);
            IsSynced = hasSnapshot = true;
        }

        private void TakeBodies(Snapshot snapshot)
        {
            bool isSame = true;
            int row = 0;
            foreach (BodyInfo body in snapshot.Bodies)
            {
                isSame = isSame && row < Bodies.Count && IsSameBody(Bodies[row], body);
                row++;
            }
            if (!isSame || row != Bodies.Count) BodiesSince = snapshot.SceneEpoch;
            BodiesUntil = snapshot.SceneEpoch;
            Bodies.Clear();
            BodyIndex.Clear();
            IndexOfId.Clear();
            foreach (BodyInfo body in snapshot.Bodies)
            {
                BodyIndex[body.Name] = Bodies.Count;
                IndexOfId[body.Id] = Bodies.Count;
                Bodies.Add(body);
            }
        }

        private static bool IsSameBody(BodyInfo a, BodyInfo b)
        {
            return a.Id == b.Id && a.Name == b.Name && a.Moving == b.Moving && a.Object == b.Object;
        }

        /// <summary>List the events up to `last`, which a snapshot contains, with ranges of those that did not arrive.</summary>
        private void ListCoveredEvents(IList<Event> waiting, long last, List<InboxMessage> covered)
        {
            long next = EventSeq + 1;
            foreach (Event one in waiting)
            {
                if (one.EventSeq < next || one.EventSeq > last) continue;
                if (one.EventSeq > next) covered.Add(new InboxMessage(next, one.EventSeq - 1));
                covered.Add(new InboxMessage(one));
                next = one.EventSeq + 1;
            }
            if (next <= last) covered.Add(new InboxMessage(next, last));
        }

        private void HoldEvent(Event one)
        {
            held.Add(one);
            if (held.Count <= MaxHeldEvents) return;
            held.RemoveAt(0);
            HeldOverflow++;
        }

        private void ApplyBody(EventKind body)
        {
            switch (body)
            {
                case ParticipantJoined joined:
                    Participants[joined.Participant.Id] = joined.Participant;
                    break;
                case ParticipantChanged changed:
                    Participants[changed.Participant.Id] = changed.Participant;
                    break;
                case ParticipantLeft left:
                    ApplyLeft(left.Participant, left.Grace);
                    break;
                case LeaseChanged changed:
                    Leases[changed.Lease.Target] = changed.Lease;
                    break;
                case LeasesChanged changed:
                    foreach (Lease lease in changed.Leases) Leases[lease.Target] = lease;
                    break;
                case ScaleChanged scaled:
                    if (!Leases.TryGetValue(scaled.Robot, out Lease before)) break;
                    Lease after = MessageCodec.Copy(before); // events that the application still reads share the old one
                    after.Scale = scaled.Scale;
                    Leases[scaled.Robot] = after;
                    break;
                case AlignmentChanged aligned:
                    if (!Participants.TryGetValue(aligned.Participant, out ParticipantInfo old)) break;
                    ParticipantInfo info = MessageCodec.Copy(old);
                    info.Alignment = aligned.Alignment;
                    Participants[info.Id] = info;
                    break;
                case AnchorMoved moved:
                    AnchorInfo anchor = Anchors.TryGetValue(moved.AnchorId, out AnchorInfo known) ? MessageCodec.Copy(known) : new AnchorInfo { Id = moved.AnchorId };
                    anchor.T_world_anchor = moved.T_world_anchor;
                    Anchors[anchor.Id] = anchor;
                    break;
                case SceneChanged scene:
                    ApplyScene(scene);
                    break;
                case EStopChanged stop:
                    IsStopped = stop.Active;
                    StopSeq = stop.StopSeq;
                    break;
                case PauseChanged pause:
                    IsPaused = pause.Paused;
                    break;
                case EpisodeChanged episode:
                    Episode = episode;
                    break;
            } // others are history only: nothing of them is in a snapshot
        }

        private void ApplyScene(SceneChanged scene)
        {
            SceneEpoch = scene.SceneEpoch;
            SceneRevision = scene.SceneRevision;
            if (scene.SceneHash.Length > 0) SceneHash = scene.SceneHash;
            if (scene.TickPeriodNs != 0) TickPeriodNs = scene.TickPeriodNs;
            // These leave robots and bodies as they are; after any other a new snapshot lists them.
            IsSynced = scene.Cause == "reset" || scene.Cause == "patch" || scene.Cause == "external";
            if (IsSynced) BodiesUntil = scene.SceneEpoch;
        }

        private void ApplyLeft(string participant, bool grace)
        {
            if (!Participants.TryGetValue(participant, out ParticipantInfo info)) return;
            if (!grace)
            {
                Participants.Remove(participant);
                return;
            }
            ParticipantInfo after = MessageCodec.Copy(info);
            after.Connected = false;
            Participants[participant] = after;
        }
    }
}
