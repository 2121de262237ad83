// Looks at sheets, from a source of codes to the session; and when codes are looked for at all.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Reports sheets, each with the head's sample of the same moment. For one thread.</summary>
    public sealed class MarkerLooks
    {
        /// <summary>A sheet nearer than this, where the alignment has it, is worth a glance [m].</summary>
        private const double GlanceM = 2.5;

        /// <summary>Cosine of the angle from the line of sight within which it is looked for.</summary>
        private const double MinCosGlance = 0.7;

        /// <summary>Codes are looked for so much longer than a sheet was in view [ns].</summary>
        private const long LingerNs = 4_000_000_000;

        private readonly IMarkerSource source;
        private readonly List<MarkerReport> reports = new List<MarkerReport>();
        private readonly SheetSighting sighting = new SheetSighting();
        private readonly HeadHistory history = new HeadHistory();
        private readonly List<Double3> places = new List<Double3>(); // of sheets, in the world
        private IReadOnlyDictionary<string, AnchorInfo> placesOf;
        private long wantedUntilNs = long.MaxValue;

        public MarkerLooks(IMarkerSource source)
        {
            this.source = source;
        }

        public readonly MarkerFilter Filter = new MarkerFilter();

        /// <summary>Looks that were handed over.</summary>
        public long Sent { get; private set; }

        /// <summary>Whether codes are looked for now.</summary>
        public bool IsActive { get; private set; }

        public MarkerSupport Support { get { return source.Support; } }

        /// <summary>Take a frame whose samples have been sent.</summary>
        public void Update(HeadsetReading reading, ISessionPort session)
        {
            long nowNs = reading.CaptureNs;
            if (reading.HasHead && reading.HeadValidity == PoseValidity.Measured) history.Add(nowNs, reading.Head);
            IsActive = IsWanted(reading, session);
            source.SetActive(IsActive);
            if (!IsActive) return;
            int count = source.Read(reports);
            for (int i = 0; i < count; i++) Take(reports[i], nowNs, session);
        }

        /// <summary>The tracking frame is another one.</summary>
        public void Reset()
        {
            Filter.Reset();
            history.Clear();
        }

        private void Take(MarkerReport report, long nowNs, ISessionPort session)
        {
            long seenNs = report.SeenNs >= 0 ? report.SeenNs : nowNs;
            if (!history.TryFind(seenNs, out long captureNs, out RigidTransform head)) return;
            bool isSheet = report.Text != null && session.Anchors.ContainsKey(report.Text);
            if (Filter.Judge(report, head, isSheet, nowNs) != MarkerVerdict.Look || !session.HasClock || !session.IsJoined) return;
            sighting.AnchorId = report.Text;
            sighting.T_tracking_anchor = report.Pose.T_tracking_anchor;
            sighting.SizeM = report.Pose.SizeM;
            sighting.CaptureNs = session.ToSessionNs(captureNs);
            sighting.T_tracking_camera = head;
            sighting.Source = source.Source;
            if (session.TryObserve(sighting)) Sent++;
        }

        /// <summary>Codes cost performance: they are looked for without a full alignment, and while a sheet is where one would see it.</summary>
        private bool IsWanted(HeadsetReading reading, ISessionPort session)
        {
            bool isWanted = session.AlignmentState != AlignmentState.Aligned || !session.TryGetAlignment(out RigidTransform T_world_tracking) || !reading.HasHead
                || SeesSheet(T_world_tracking * reading.Head, session);
            if (isWanted) wantedUntilNs = reading.CaptureNs + LingerNs;
            return isWanted || reading.CaptureNs < wantedUntilNs;
        }

        private bool SeesSheet(RigidTransform T_world_head, ISessionPort session)
        {
            if (!ReferenceEquals(placesOf, session.Anchors))
            {
                placesOf = session.Anchors;
                places.Clear();
                foreach (AnchorInfo anchor in placesOf.Values) places.Add(SceneDecoder.ToTransform(anchor.T_world_anchor).Position);
            }
            Double3 ahead = T_world_head.Rotation.Rotate(new Double3(1, 0, 0));
            foreach (Double3 place in places)
            {
                Double3 line = place - T_world_head.Position;
                double distance = line.Length;
                if (distance <= GlanceM && Double3.Dot(ahead, line) >= MinCosGlance * distance) return true;
            }
            return false;
        }
    }
}
