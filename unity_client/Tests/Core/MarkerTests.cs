using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    /// <summary>Codes of each source end at the place of one sheet, and only those that are seen now are looks.</summary>
    [TestFixture]
    public class MarkerTests
    {
        private const double Edge = 0.15;
        private const long Ms = 1_000_000;

        /// <summary>Three sheets without symmetry: `T_tracking_anchor` by its right, top and normal.</summary>
        private static readonly RigidTransform[] Sheets =
        {
            // On a wall ahead, upright, to the left of the head: right is -y, top is z, the normal points back.
            Make(new Double3(1.2, 0.3, 1.1), new Double3(0, -1, 0), new Double3(0, 0, 1)),
            // Flat on a table, its top edge away from the person and to the left.
            Make(new Double3(0.7, -0.4, 0.8), new Double3(0.6, -0.8, 0), new Double3(0.8, 0.6, 0)),
            // On a slope, turned.
            new RigidTransform(new Double3(-0.2, 0.9, 0.4), DoubleQuaternion.FromAxisAngle(new Double3(1, -2, 0.5), 1.1)),
        };

        private static readonly string[] Sources = { "AR Foundation", "MRUK", "Microsoft most stable", "Microsoft center" };

        [TestCase(0)]
        [TestCase(1)]
        [TestCase(2)]
        [TestCase(3)]
        public void EverySourceIsConvertedToTheSheet(int source)
        {
            foreach (RigidTransform sheet in Sheets)
            {
                MarkerPose found = Report(source, sheet);
                Assert.AreEqual(Edge, found.SizeM, 1e-6, Sources[source]);
                Assert.LessOrEqual((found.T_tracking_anchor.Position - sheet.Position).Length, 1e-6);
                foreach (Double3 axis in new[] { new Double3(1, 0, 0), new Double3(0, 1, 0), new Double3(0, 0, 1) })
                {
                    Assert.LessOrEqual((found.T_tracking_anchor.Rotation.Rotate(axis) - sheet.Rotation.Rotate(axis)).Length, 1e-6);
                }
            }
        }

        [Test]
        public void CodesThatAreNotSquareHaveNoSize()
        {
            UnityPose pose = new UnityPose(new Float3(1, 1, 1), new FloatQuaternion(0, 0, 0, 1));
            Assert.AreEqual(0.15, MarkerAxes.FromArFoundation(pose, 0.14, 0.16).SizeM, 1e-9);
            foreach (double height in new[] { 0, -0.15, 0.3, 0.1, double.NaN })
            {
                Assert.AreEqual(0, MarkerAxes.FromArFoundation(pose, 0.15, height).SizeM);
            }
        }

        [Test]
        public void SecondOfTwoReportsThatAgreeIsALook()
        {
            MarkerFilter filter = new MarkerFilter();
            MarkerReport report = Seen(0);
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, report, 0));
            Move(report, 0.3);
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, report, 100 * Ms), "it disagrees");
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.Look, Judge(filter, report, 200 * Ms));
            Assert.AreEqual(MarkerVerdict.Repeated, Judge(filter, report, 400 * Ms));
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.TooSoon, Judge(filter, report, 250 * Ms));
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.Look, Judge(filter, report, 300 * Ms));
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, report, 9_000 * Ms), "after a pause");
            Assert.AreEqual(2, filter.Count(MarkerVerdict.Look));
            Assert.AreEqual(3, filter.Count(MarkerVerdict.First));
        }

        [Test]
        public void CodesThatAreRememberedAreNoLooks()
        {
            MarkerFilter filter = new MarkerFilter();
            MarkerReport report = Seen(0);
            report.SeenNs = 1_000 * Ms; // from before the application was started
            Assert.AreEqual(MarkerVerdict.Remembered, Judge(filter, report, 60_000 * Ms));
            report.SeenNs = 60_000 * Ms;
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, report, 60_020 * Ms));
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.Remembered, Judge(filter, report, 60_120 * Ms), "another pose, but no later sight");
            report.SeenNs = 60_200 * Ms;
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.Look, Judge(filter, report, 60_220 * Ms));
            report.IsTracked = false;
            Move(report, 0.001);
            Assert.AreEqual(MarkerVerdict.Remembered, Judge(filter, report, 60_420 * Ms));
        }

        [Test]
        public void ReportsThatSayNothingAreCounted()
        {
            MarkerFilter filter = new MarkerFilter();
            MarkerReport report = Seen(0);
            report.Text = null;
            Assert.AreEqual(MarkerVerdict.NoText, Judge(filter, report, 0));
            report.Text = "https://example.org";
            Assert.AreEqual(MarkerVerdict.OtherCode, filter.Judge(report, Head, false, 0));
            Assert.AreEqual("https://example.org", filter.OtherCode);
            report.Pose = new MarkerPose(Sheets[0], 0);
            Assert.AreEqual(MarkerVerdict.NoSize, Judge(filter, report, 0));
            report.Pose = new MarkerPose(new RigidTransform(default, Sheets[0].Rotation), Edge);
            Assert.AreEqual(MarkerVerdict.NotLocated, Judge(filter, report, 0));
            report.Pose = new MarkerPose(new RigidTransform(new Double3(double.NaN, 0, 1), Sheets[0].Rotation), Edge);
            Assert.AreEqual(MarkerVerdict.NotLocated, Judge(filter, report, 0));
            report.Pose = new MarkerPose(new RigidTransform(Sheets[0].Position, default), Edge);
            Assert.AreEqual(MarkerVerdict.NotLocated, Judge(filter, report, 0));
            Assert.AreEqual(0, filter.Count(MarkerVerdict.Look));
        }

        [Test]
        public void CodesThatCamerasCannotSeeAreNoLooks()
        {
            RigidTransform wall = Sheets[0];
            RigidTransform[] heads =
            {
                new RigidTransform(Head.Position, DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), Math.PI)), // turned away
                new RigidTransform(new Double3(2.5, 0.3, 1.1), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), Math.PI)), // behind the wall
                new RigidTransform(new Double3(-6, 0.3, 1.1), DoubleQuaternion.Identity), // too far
                new RigidTransform(new Double3(1.2, 1.3, 1.1), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), -Math.PI / 2)), // along the wall
            };
            foreach (RigidTransform head in heads)
            {
                MarkerReport report = Seen(0);
                Assert.AreEqual(MarkerVerdict.OutOfView, new MarkerFilter().Judge(report, head, true, 0), head.ToString());
                report.Pose = new MarkerPose(wall, Edge);
                Assert.AreEqual(MarkerVerdict.First, new MarkerFilter().Judge(report, Head, true, 0));
            }
        }

        [Test]
        public void FilterIsBoundedAndAnotherFrameBeginsAnew()
        {
            MarkerFilter filter = new MarkerFilter();
            for (int i = 0; i < 1000; i++)
            {
                MarkerReport one = Seen(0);
                one.Id = i.ToString();
                Assert.AreEqual(MarkerVerdict.First, Judge(filter, one, i * Ms));
            }
            MarkerReport newest = Seen(0);
            newest.Id = "999";
            Move(newest, 0.001);
            Assert.AreEqual(MarkerVerdict.Look, Judge(filter, newest, 1_000 * Ms));
            MarkerReport oldest = Seen(0);
            oldest.Id = "0";
            Move(oldest, 0.001);
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, oldest, 1_000 * Ms), "it was forgotten");
            filter.Reset();
            Move(newest, 0.001);
            Assert.AreEqual(MarkerVerdict.First, Judge(filter, newest, 1_200 * Ms));
        }

        [Test]
        public void HeadIsFoundAtTheTimeOfASight()
        {
            HeadHistory history = new HeadHistory();
            Assert.IsFalse(history.TryFind(0, out _, out _));
            for (int i = 0; i < 1000; i++) history.Add(i * Ms, new RigidTransform(new Double3(i, 0, 0), DoubleQuaternion.Identity));
            Assert.IsTrue(history.TryFind(900 * Ms + 300_000, out long captureNs, out RigidTransform head));
            Assert.AreEqual(900 * Ms, captureNs);
            Assert.AreEqual(900, head.Position.X);
            Assert.IsTrue(history.TryFind(3 * Ms, out captureNs, out _));
            Assert.AreEqual(744 * Ms, captureNs, "the oldest that is kept");
            history.Clear();
            Assert.IsTrue(history.IsEmpty);
        }

        private static readonly RigidTransform Head = new RigidTransform(new Double3(0.2, 0.1, 1.5), DoubleQuaternion.Identity);

        private static MarkerVerdict Judge(MarkerFilter filter, MarkerReport report, long nowNs)
        {
            return filter.Judge(report, Head, true, nowNs);
        }

        private static MarkerReport Seen(int number)
        {
            return new MarkerReport { Id = "1", Text = "table", Pose = new MarkerPose(Sheets[number], Edge) };
        }

        private static void Move(MarkerReport report, double byM)
        {
            RigidTransform pose = report.Pose.T_tracking_anchor;
            report.Pose = new MarkerPose(new RigidTransform(pose.Position + new Double3(0, byM, 0), pose.Rotation), report.Pose.SizeM);
        }

        private static RigidTransform Make(Double3 at, Double3 right, Double3 top)
        {
            return new RigidTransform(at, FromColumns(right, top, Double3.Cross(right, top)));
        }

        /// <summary>Return what a source would report of a sheet, from the axes that its documentation states.</summary>
        private static MarkerPose Report(int source, RigidTransform sheet)
        {
            // Right, top, normal and corner of the code in Unity, as a person sees them.
            Float3 right = UnityAxes.ToUnity(sheet.Rotation.Rotate(new Double3(1, 0, 0)));
            Float3 top = UnityAxes.ToUnity(sheet.Rotation.Rotate(new Double3(0, 1, 0)));
            Float3 normal = UnityAxes.ToUnity(sheet.Rotation.Rotate(new Double3(0, 0, 1)));
            Float3 center = UnityAxes.ToUnity(sheet.Position);
            Float3 corner = UnityAxes.ToUnity(sheet.TransformPoint(new Double3(-Edge / 2, Edge / 2, 0)));
            switch (source)
            {
                case 0:
                    return MarkerAxes.FromArFoundation(new UnityPose(center, UnityRotation(right, normal, top)), Edge, Edge);
                case 1:
                    // The anchor is beside the centre: 2 cm to the right (its -X), 1 cm below.
                    Float3 beside = UnityAxes.ToUnity(sheet.TransformPoint(new Double3(0.02, -0.01, 0)));
                    return MarkerAxes.FromMruk(new UnityPose(beside, UnityRotation(Negate(right), top, normal)), 0.02, 0.01, Edge, Edge);
                case 2:
                    return MarkerAxes.FromMicrosoftMostStable(new UnityPose(corner, UnityRotation(right, Negate(top), normal)), Edge / 2, Edge / 2, Edge, Edge);
                default:
                    return MarkerAxes.FromMicrosoftCenter(new UnityPose(center, UnityRotation(right, Negate(top), normal)), Edge, Edge);
            }
        }

        private static Float3 Negate(Float3 v) { return new Float3(-v.X, -v.Y, -v.Z); }

        /// <summary>Return the rotation whose local axes are these, which is all that Unity has: a matrix of determinant 1.</summary>
        private static FloatQuaternion UnityRotation(Float3 x, Float3 y, Float3 z)
        {
            Double3 a = new Double3(x.X, x.Y, x.Z), b = new Double3(y.X, y.Y, y.Z), c = new Double3(z.X, z.Y, z.Z);
            Assert.AreEqual(1, Double3.Dot(Double3.Cross(a, b), c), 1e-6, "no rotation: an axis is stated the wrong way");
            DoubleQuaternion q = FromColumns(a, b, c);
            return new FloatQuaternion((float)q.X, (float)q.Y, (float)q.Z, (float)q.W);
        }

        /// <summary>Return the quaternion of a rotation matrix by its columns (Shepperd 1978).</summary>
        private static DoubleQuaternion FromColumns(Double3 x, Double3 y, Double3 z)
        {
            double trace = x.X + y.Y + z.Z;
            double[] four = { trace, x.X, y.Y, z.Z };
            int k = Array.IndexOf(four, Math.Max(Math.Max(four[0], four[1]), Math.Max(four[2], four[3])));
            double s = Math.Sqrt(1 + 2 * four[k] - trace) / 2;
            double t = 0.25 / s;
            switch (k)
            {
                case 0: return new DoubleQuaternion(s, (y.Z - z.Y) * t, (z.X - x.Z) * t, (x.Y - y.X) * t);
                case 1: return new DoubleQuaternion((y.Z - z.Y) * t, s, (x.Y + y.X) * t, (z.X + x.Z) * t);
                case 2: return new DoubleQuaternion((z.X - x.Z) * t, (x.Y + y.X) * t, s, (y.Z + z.Y) * t);
                default: return new DoubleQuaternion((x.Y - y.X) * t, (z.X + x.Z) * t, (y.Z + z.Y) * t, s);
            }
        }
    }
}
