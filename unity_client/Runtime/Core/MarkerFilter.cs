// Which reports of a code are looks at a sheet. Runtimes remember codes, go on reporting what is out of sight, report the origin
// before they have located anything, and repeat poses; the session has its own rules for what comes through (anchors/looks.py).
using System;
using System.Collections.Generic;

namespace IrisSession.Core
{
    /// <summary>What became of a report.</summary>
    public enum MarkerVerdict
    {
        /// <summary>A look: send it.</summary>
        Look,

        /// <summary>The runtime has not read the code yet.</summary>
        NoText,

        /// <summary>A code that is no sheet of the session.</summary>
        OtherCode,

        /// <summary>Not seen now: the runtime says so, or its time of the last sight has not moved.</summary>
        Remembered,

        /// <summary>The pose of the report before, bit for bit.</summary>
        Repeated,

        /// <summary>The origin of the tracking frame, or no rotation: not located yet.</summary>
        NotLocated,

        /// <summary>Without a size, or with one that no sheet has.</summary>
        NoSize,

        /// <summary>Behind the head, too far, or seen from the back: nothing that cameras see now.</summary>
        OutOfView,

        /// <summary>The first of two reports that agree has to wait for the second: first ones can be wrong.</summary>
        First,

        /// <summary>Sooner after the last look than looks are sent.</summary>
        TooSoon,
    }

    /// <summary>One report of a code by the runtime. Made once and filled again.</summary>
    public sealed class MarkerReport
    {
        /// <summary>The runtime's own id of the code, for as long as it tracks it.</summary>
        public string Id = "";

        /// <summary>What the code says, null or empty while it is not decoded.</summary>
        public string Text = "";
        public MarkerPose Pose;

        /// <summary>What the runtime says: tracked now. It does not mean seen.</summary>
        public bool IsTracked = true;

        /// <summary>When the runtime last saw it, on the clock of `nowNs`; -1 where it does not say.</summary>
        public long SeenNs = -1;
    }

    /// <summary>Decides which reports are looks, and counts the others. For one thread; it allocates for new codes only.</summary>
    public sealed class MarkerFilter
    {
        /// <summary>Looks per sheet: more say nothing more, as the errors of one place are common to them [ns].</summary>
        private const long PeriodNs = 100_000_000;

        /// <summary>A sight older than this is remembered [ns]: the runtime's own delay is some tenths of a second.</summary>
        private const long MaxAgeNs = 1_000_000_000;

        /// <summary>A report after such a time is a first one again [ns].</summary>
        private const long ForgetNs = 5_000_000_000;

        /// <summary>Two reports agree within this [m], [rad]: codes lie still, and ours have errors of millimetres and degrees.</summary>
        private const double AgreeM = 0.05;
        private const double AgreeRad = 0.2;

        /// <summary>Nearer to the origin than this is the origin [m].</summary>
        private const double OriginM = 1e-4;

        private const double MinSizeM = 0.02;
        private const double MaxSizeM = 2.0;
        private const double MaxDistanceM = 5.0;

        /// <summary>Cosine of the greatest angle from the line of sight: cameras of headsets see 100 degrees and more in all.</summary>
        private const double MinCosView = 0.5;

        /// <summary>Cosine between the normal of the sheet and the direction to the head: 80 degrees, flatter is not read.</summary>
        private const double MinCosTilt = 0.17;

        /// <summary>Codes that are followed; of more the one that was reported longest ago is forgotten.</summary>
        private const int MaxMarkers = 64;

        private sealed class Known
        {
            public RigidTransform Pose;
            public long AtNs = long.MinValue;
            public long SeenNs = long.MinValue;
            public long SentNs = long.MinValue;
        }

        private readonly Dictionary<string, Known> markers = new Dictionary<string, Known>();
        private readonly long[] counts = new long[Enum.GetValues(typeof(MarkerVerdict)).Length];

        /// <summary>The text of the newest code that is no sheet of the session, null before one.</summary>
        public string OtherCode { get; private set; }

        /// <summary>Return how many reports had a verdict.</summary>
        public long Count(MarkerVerdict verdict)
        {
            return counts[(int)verdict];
        }

        /// <summary>Decide about a report.</summary>
        /// <param name="report">What the runtime says.</param>
        /// <param name="T_tracking_head">The head at that moment.</param>
        /// <param name="isSheet">Whether the session has a sheet with this text.</param>
        /// <param name="nowNs">A monotonic clock [ns].</param>
        public MarkerVerdict Judge(MarkerReport report, RigidTransform T_tracking_head, bool isSheet, long nowNs)
        {
            MarkerVerdict verdict = Find(report, T_tracking_head, isSheet, nowNs);
            counts[(int)verdict]++;
            return verdict;
        }

        /// <summary>Forget what was seen: the tracking frame is another one.</summary>
        public void Reset()
        {
            markers.Clear();
        }

        private MarkerVerdict Find(MarkerReport report, RigidTransform T_tracking_head, bool isSheet, long nowNs)
        {
            if (string.IsNullOrEmpty(report.Text)) return MarkerVerdict.NoText;
            if (!isSheet)
            {
                OtherCode = report.Text;
                return MarkerVerdict.OtherCode;
            }
            RigidTransform pose = report.Pose.T_tracking_anchor;
            if (!IsLocated(pose)) return MarkerVerdict.NotLocated;
            if (!(report.Pose.SizeM >= MinSizeM && report.Pose.SizeM <= MaxSizeM)) return MarkerVerdict.NoSize;
            if (!report.IsTracked) return MarkerVerdict.Remembered;
            Known known = FindKnown(report.Id);
            RigidTransform before = known.Pose;
            bool isFirst = nowNs - known.AtNs > ForgetNs || known.AtNs == long.MinValue;
            bool isRepeated = !isFirst && pose.Equals(before);
            bool isOld = report.SeenNs >= 0 && (report.SeenNs <= known.SeenNs || nowNs - report.SeenNs > MaxAgeNs);
            if (report.SeenNs > known.SeenNs) known.SeenNs = report.SeenNs;
            if (isOld) return MarkerVerdict.Remembered;
            if (isRepeated) return MarkerVerdict.Repeated; // and does not count as a report: a code that lies still is one look
            if (!IsInView(pose, T_tracking_head)) return MarkerVerdict.OutOfView;
            known.Pose = pose;
            known.AtNs = nowNs;
            if (isFirst || !Agree(pose, before)) return MarkerVerdict.First;
            if (known.SentNs != long.MinValue && nowNs - known.SentNs < PeriodNs) return MarkerVerdict.TooSoon;
            known.SentNs = nowNs;
            return MarkerVerdict.Look;
        }

        private Known FindKnown(string id)
        {
            if (markers.TryGetValue(id, out Known known)) return known;
            if (markers.Count >= MaxMarkers) ForgetOldest();
            return markers[id] = new Known();
        }

        private void ForgetOldest()
        {
            string oldest = null;
            long atNs = long.MaxValue;
            foreach (KeyValuePair<string, Known> one in markers)
            {
                if (oldest != null && one.Value.AtNs >= atNs) continue;
                oldest = one.Key;
                atNs = one.Value.AtNs;
            }
            if (oldest != null) markers.Remove(oldest);
        }

        private static bool IsLocated(RigidTransform pose)
        {
            double distance = pose.Position.Length;
            DoubleQuaternion q = pose.Rotation;
            double norm = q.W * q.W + q.X * q.X + q.Y * q.Y + q.Z * q.Z;
            return distance > OriginM && distance < 1e6 && Math.Abs(norm - 1) < 1e-3;
        }

        private static bool IsInView(RigidTransform pose, RigidTransform T_tracking_head)
        {
            Double3 line = pose.Position - T_tracking_head.Position;
            double distance = line.Length;
            if (!(distance > OriginM && distance <= MaxDistanceM)) return false;
            double ahead = Double3.Dot(T_tracking_head.Rotation.Rotate(new Double3(1, 0, 0)), line);
            double facing = -Double3.Dot(pose.Rotation.Rotate(new Double3(0, 0, 1)), line);
            return ahead >= MinCosView * distance && facing >= MinCosTilt * distance;
        }

        private static bool Agree(RigidTransform a, RigidTransform b)
        {
            return (a.Position - b.Position).Length <= AgreeM && DoubleQuaternion.Angle(a.Rotation, b.Rotation) <= AgreeRad;
        }
    }
}
