// What is wrong now, and what a person does about it: the most urgent first. A layer that draws panels shows these lines and decides
// nothing.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>What is wrong. In the order of urgency.</summary>
    public enum AdviceKind
    {
        /// <summary>The e-stop is active.</summary>
        Stopped,

        /// <summary>The link, the wrong certificate or the lack of a code: text of the transport.</summary>
        Link,
        OtherVersion,

        /// <summary>This headset may not join; `Reason` is a `RefusalCode` or like one.</summary>
        Refused,

        /// <summary>There is no session yet, or the connection was lost.</summary>
        Joining,

        /// <summary>The state is old: the world is drawn grey.</summary>
        Stale,

        /// <summary>The simulation stands still.</summary>
        Stalled,
        TrackingLost,
        Covered,
        NotAligned,
        ViewOnly,
        Unconfirmed,

        /// <summary>A robot of ours holds for a reason that is not the open clutch; `Reason` is a `HoldReason`.</summary>
        Holding,

        /// <summary>A request was denied; `Reason` is a `DenialReason`.</summary>
        Denied,

        /// <summary>A permission is missing; `Reason` is its name.</summary>
        Permission,

        /// <summary>The headset finds no sheets by itself.</summary>
        NoMarkers,
        SceneUnreadable,
        SceneIncomplete,
        OverBudget,
        CacheFull,
        CacheUnwritable,
        LinkSlow,
        Paused,
    }

    /// <summary>One thing that is wrong.</summary>
    public readonly struct Advice
    {
        public readonly AdviceKind Kind;

        /// <summary>The reason of the protocol, where there is one.</summary>
        public readonly string Reason;
        public readonly Phrase Phrase;

        internal Advice(AdviceKind kind, Phrase phrase, string reason = "")
        {
            Kind = kind;
            Phrase = phrase;
            Reason = reason;
        }
    }

    /// <summary>What of a scene and its cache a person may have to know. Never changes: another one replaces it.</summary>
    public sealed class SceneFacts
    {
        public readonly SceneState State;

        /// <summary>Why the specification cannot be had, for people; else empty.</summary>
        public readonly string Failure;

        /// <summary>Assets that could not be had.</summary>
        public readonly int FailedCount;

        /// <summary>Visuals that are left out because there would be too many draw calls.</summary>
        public readonly int HiddenCount;

        /// <summary>False when the scene exceeds the budget of the headset.</summary>
        public readonly bool Fits;

        /// <summary>`Kept`, or why the newest asset was not.</summary>
        public readonly CacheResult Cache;

        public SceneFacts(SceneFollower follower, CacheResult cache)
        {
            State = follower.State;
            Failure = follower.Failure;
            FailedCount = follower.FailedCount;
            ScenePlan plan = follower.State == SceneState.Shown ? follower.Plan : null;
            HiddenCount = plan == null ? 0 : plan.HiddenCount;
            Fits = plan == null || plan.Fits;
            Cache = cache;
        }
    }

    /// <summary>Collects what is wrong. Made once; for the thread of the connection.</summary>
    public sealed class ClientAdvice
    {
        /// <summary>Older state is shown as old [ns].</summary>
        public const long StaleNs = 300_000_000;

        /// <summary>Time for which a denial is shown [ns].</summary>
        private const long NoticeNs = 5_000_000_000;

        /// <summary>Sheets that are named at most.</summary>
        private const int MaxSheets = 3;

        private readonly ClientConnection connection;
        private readonly ClientAlignment alignment;
        private readonly Dictionary<string, string> holds = new Dictionary<string, string>();
        private volatile SceneFacts scene;
        private long waitsSince = -1;
        private Denial denial;
        private long denialUntil;

        public ClientAdvice(ClientConnection connection, ClientAlignment alignment)
        {
            this.connection = connection;
            this.alignment = alignment;
        }

        /// <summary>What the headset reports; null: nothing.</summary>
        public HeadsetState Headset { get; set; }

        /// <summary>The scene; null: none is shown. May be set by any thread.</summary>
        public SceneFacts Scene
        {
            get { return scene; }
            set { scene = value; }
        }

        /// <summary>Why the transport has no link, in words, as it says them; empty while it has one.</summary>
        public Phrase Link { get; set; } = new Phrase("", "");

        /// <summary>True when there is no link because the other end speaks another version.</summary>
        public bool IsLinkOfOtherVersion { get; set; }

        /// <summary>`T_tracking_head`, for the distance to a sheet; null: not known.</summary>
        public RigidTransform? Head { get; set; }

        /// <summary>Take feedback of a robot.</summary>
        public void TakeFeedback(Feedback feedback)
        {
            if (holds.Count < 1024 || holds.ContainsKey(feedback.Robot)) holds[feedback.Robot] = feedback.HoldReason;
        }

        /// <summary>A request was denied: it is shown for 5 s.</summary>
        public void TakeDenial(Denial denial, long nowNs)
        {
            this.denial = denial;
            denialUntil = nowNs + NoticeNs;
        }

        /// <summary>True when the newest state is too old to be taken for the present.</summary>
        public bool IsStale(long nowNs) { return MeasureAge(nowNs) > StaleNs; }

        /// <summary>List what is wrong into `advice`, the most urgent first.</summary>
        public void List(long nowNs, List<Advice> advice)
        {
            advice.Clear();
            SessionMirror mirror = connection.Mirror;
            if (mirror.IsStopped) Add(advice, AdviceKind.Stopped, Words.OfHold(HoldReason.Estop), HoldReason.Estop);
            ListConnection(nowNs, advice);
            bool isReady = connection.IsJoined && connection.IsStalled == false;
            if (connection.IsStalled) Add(advice, AdviceKind.Stalled, Words.OfFault(FaultCode.Stalled), FaultCode.Stalled);
            ListHeadset(advice);
            if (isReady && mirror.IsSynced)
            {
                ListAlignment(advice);
                ListHolds(advice);
            }
            if (denial != null && nowNs < denialUntil) Add(advice, AdviceKind.Denied, Words.OfDenial(denial), denial.Reason);
            ListScene(advice);
            if (connection.Budget != null && connection.Budget.BudgetClass != BudgetClass.Full)
            {
                bool isPaused = connection.Budget.BudgetClass == BudgetClass.None;
                Add(advice, AdviceKind.LinkSlow, new Phrase(isPaused ? "pictures are paused: the link is too slow" : "pictures come less often: the link is too slow for all of them", "come nearer to the access point"), connection.Budget.BudgetClass);
            }
            if (mirror.IsPaused) Add(advice, AdviceKind.Paused, new Phrase("the session is paused", ""));
            advice.Sort((a, b) => a.Kind.CompareTo(b.Kind));
        }

        private static void Add(List<Advice> advice, AdviceKind kind, Phrase phrase, string reason = "")
        {
            advice.Add(new Advice(kind, phrase, reason));
        }

        /// <summary>Return the age of the newest state now [ns]; it grows while nothing comes. Before the first: how long it is waited for.</summary>
        private long MeasureAge(long nowNs)
        {
            bool isWaited = connection.Phase == ConnectionPhase.Ready && connection.Stream.Counters.Delivered == 0;
            waitsSince = !isWaited ? -1 : waitsSince < 0 ? nowNs : waitsSince;
            if (isWaited) return nowNs - waitsSince;
            return connection.Clock.IsSettled && connection.Stream.Counters.Delivered > 0 ? connection.Clock.SessionNs(nowNs) - connection.Stream.Header.SessionTime : 0;
        }

        private void ListConnection(long nowNs, List<Advice> advice)
        {
            Refused failure = connection.Failure;
            if (failure != null)
            {
                bool isVersion = failure.Code == RefusalCode.Version;
                Add(advice, isVersion ? AdviceKind.OtherVersion : AdviceKind.Refused, Words.OfRefusal(failure), failure.Code);
                return;
            }
            if (Link.What.Length > 0) Add(advice, IsLinkOfOtherVersion ? AdviceKind.OtherVersion : AdviceKind.Link, Link);
            else if (!connection.IsJoined)
            {
                Refused passing = connection.RetryableRefusal;
                if (passing != null) Add(advice, AdviceKind.Joining, Words.OfRefusal(passing), passing.Code);
                else Add(advice, AdviceKind.Joining, new Phrase(connection.Describe(), connection.Welcome == null ? "is the session running, and is this headset in its network?" : ""));
            }
            if (connection.IsJoined && IsStale(nowNs)) Add(advice, AdviceKind.Stale, new Phrase("the scene is " + Words.FormatAge(MeasureAge(nowNs)) + " old", "wait until it moves again"));
        }

        private void ListHeadset(List<Advice> advice)
        {
            if (Headset == null) return;
            if (!Headset.IsTracking) Add(advice, AdviceKind.TrackingLost, new Phrase("this headset does not know where it is", "look around slowly, with light on"));
            if (Headset.Focus == AppFocus.Covered) Add(advice, AdviceKind.Covered, new Phrase("a menu of the headset is open: robots hold", "close it, then open and close the clutch"));
            if (!Headset.HasMarkerSupport) Add(advice, AdviceKind.NoMarkers, new Phrase("this headset cannot find sheets by itself", "touch the marks of a sheet, or ask a director to place it"));
            else if (!Headset.CanSeeSheets) Add(advice, AdviceKind.Permission, new Phrase("this app may not see sheets", "allow the camera and the room in the settings of the headset, or touch the marks of a sheet"), "sheets");
            if (Headset[HeadsetPermission.Hands] == PermissionState.Denied) Add(advice, AdviceKind.Permission, new Phrase("this app may not see hands", "use controllers, or allow it in the settings of the headset"), "hands");
        }

        private void ListAlignment(List<Advice> advice)
        {
            if (alignment.State == AlignmentState.Aligned)
            {
                if (IsHeldFor(HoldReason.Unconfirmed)) Add(advice, AdviceKind.Unconfirmed, new Phrase("the alignment is doubted: robots hold", "glance at " + DescribeSheets() + ", then open and close the clutch"), HoldReason.Unconfirmed);
                return;
            }
            bool isProvisional = alignment.State == AlignmentState.Provisional;
            string what = isProvisional ? "aligned well enough to look, not to drive" : "this headset is not aligned";
            string remedy = connection.Mirror.Anchors.Count == 0 ? "ask a director to place it" : "look at " + DescribeSheets() + ", from about half a metre";
            Add(advice, isProvisional ? AdviceKind.ViewOnly : AdviceKind.NotAligned, new Phrase(what, remedy), isProvisional ? HoldReason.ViewOnly : HoldReason.Unaligned);
        }

        private void ListHolds(List<Advice> advice)
        {
            foreach (KeyValuePair<string, string> one in holds)
            {
                bool isSaid = one.Value.Length == 0 || one.Value == HoldReason.ClutchOpen || one.Value == HoldReason.NoSample || one.Value == HoldReason.Estop
                    || one.Value == HoldReason.Unaligned || one.Value == HoldReason.ViewOnly || one.Value == HoldReason.Unconfirmed;
                if (isSaid || connection.FindLeaseVersion(one.Key) < 0) continue;
                Phrase why = Words.OfHold(one.Value);
                Add(advice, AdviceKind.Holding, new Phrase(one.Key + " holds: " + why.What, why.Remedy), one.Value);
            }
        }

        private void ListScene(List<Advice> advice)
        {
            SceneFacts now = scene;
            if (now == null) return;
            if (now.State == SceneState.Unreadable) Add(advice, AdviceKind.SceneUnreadable, new Phrase("the scene cannot be shown: " + now.Failure, "update the older of app and session"));
            if (now.FailedCount > 0) Add(advice, AdviceKind.SceneIncomplete, new Phrase(now.FailedCount + " parts of the scene did not come", "join again to fetch them"));
            if (!now.Fits)
            {
                Add(advice, AdviceKind.OverBudget, new Phrase(now.HiddenCount > 0 ? now.HiddenCount + " small things are not shown: the scene is too large for this headset" : "the scene is larger than this headset draws smoothly", "show fewer groups, or a simpler scene"));
            }
            if (now.Cache == CacheResult.Full) Add(advice, AdviceKind.CacheFull, new Phrase("the scene does not fit into the cache: it is fetched again at every start", "raise the limit of the cache in the settings of this app"));
            if (now.Cache == CacheResult.Unwritable) Add(advice, AdviceKind.CacheUnwritable, new Phrase("the scene cannot be kept on this headset", "make room on it"));
        }

        private bool IsHeldFor(string reason)
        {
            foreach (KeyValuePair<string, string> one in holds) if (one.Value == reason && connection.FindLeaseVersion(one.Key) >= 0) return true;
            return false;
        }

        /// <summary>Return which sheets there are; with an alignment, which is nearest and how far it is.</summary>
        private string DescribeSheets()
        {
            Dictionary<string, AnchorInfo> anchors = connection.Mirror.Anchors;
            if (anchors.Count == 0) return "a sheet";
            if (Head != null && alignment.TryGetTransform(out RigidTransform T_world_tracking))
            {
                Double3 head = T_world_tracking.TransformPoint(Head.Value.Position);
                string nearest = "";
                double least = double.PositiveInfinity;
                foreach (AnchorInfo anchor in anchors.Values)
                {
                    double distance = (SceneDecoder.ToTransform(anchor.T_world_anchor).Position - head).Length;
                    if (!(distance < least)) continue;
                    least = distance;
                    nearest = anchor.Id;
                }
                if (nearest.Length > 0) return "sheet " + PairingLink.Quote(nearest) + ", " + Words.FormatLength(least) + " away";
            }
            List<string> names = new List<string>(anchors.Keys);
            names.Sort(string.CompareOrdinal);
            string listed = string.Join(" or ", names.GetRange(0, Math.Min(MaxSheets, names.Count)).ConvertAll(PairingLink.Quote));
            return "sheet " + listed + (names.Count > MaxSheets ? " or another one" : "");
        }
    }
}
