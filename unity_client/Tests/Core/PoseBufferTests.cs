// Display buffer: interpolates between frames, never extrapolates, never goes back.
using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class PoseBufferTests
    {
        private const long Ms = 1_000_000;
        private readonly double[] shownRows = new double[7];

        [Test]
        public void SlerpHasConstantSpeedAndTakesTheShortWay()
        {
            double[] a = Frame(0.0, 0.0);
            double[] b = Frame(1.0, 2.0);
            for (int k = 3; k < 7; k++) b[k] = -b[k]; // the same orientation, opposite sign
            foreach (double fraction in new[] { 0.0, 0.25, 0.5, 1.0 })
            {
                PoseBuffer.Interpolate(a, b, fraction, shownRows);
                RigidTransform pose = RigidTransform.FromRow(shownRows, 0);
                Assert.AreEqual(fraction, pose.Position.X, 1e-12);
                Assert.AreEqual(2.0 * fraction, DoubleQuaternion.Angle(pose.Rotation, RigidTransform.FromRow(a, 0).Rotation), 1e-9);
            }
        }

        [Test]
        public void PastIsInterpolatedWithItsAge()
        {
            PoseBuffer buffer = new PoseBuffer(30 * Ms);
            Assert.IsFalse(buffer.TryGetPoses(0, shownRows, out _));
            for (int i = 0; i < 40; i++) buffer.Add(i * 16 * Ms, Frame(0.016 * i, 0));
            Assert.IsTrue(buffer.TryGetPoses(640 * Ms, shownRows, out ShownPoses shown));
            Assert.AreEqual(0.610, shownRows[0], 1e-12);
            Assert.AreEqual(610 * Ms, shown.SessionTimeNs);
            Assert.AreEqual(30 * Ms, shown.AgeNs);
            Assert.IsFalse(shown.IsStarved);
            Assert.IsFalse(buffer.TryGetPoses(640 * Ms, new double[14], out _));
        }

        [Test]
        public void StarvedDisplayKeepsTheNewestFrameAndIsStaleAfterThreeTenths()
        {
            PoseBuffer buffer = new PoseBuffer(10 * Ms);
            Assert.IsTrue(buffer.IsStale(0));
            buffer.Add(0, Frame(1.0, 0));
            Assert.IsFalse(buffer.IsStale(300 * Ms));
            Assert.IsTrue(buffer.IsStale(300 * Ms + 1));
            Assert.IsTrue(buffer.TryGetPoses(500 * Ms, shownRows, out ShownPoses shown));
            Assert.AreEqual(1.0, shownRows[0]);
            Assert.AreEqual(500 * Ms, shown.AgeNs);
            Assert.IsTrue(shown.IsStarved);
            Assert.AreEqual(1, buffer.Starvations);
        }

        [Test]
        public void DisplayedTimeNeverGoesBackAndOldFramesAreCounted()
        {
            PoseBuffer buffer = new PoseBuffer(10 * Ms);
            for (int i = 0; i < 4; i++) buffer.Add(i * 10 * Ms, Frame(i, 0));
            buffer.TryGetPoses(35 * Ms, shownRows, out ShownPoses first);
            Assert.AreEqual(2.5, shownRows[0], 1e-12);
            buffer.TryGetPoses(25 * Ms, shownRows, out ShownPoses again);
            Assert.AreEqual(first.SessionTimeNs, again.SessionTimeNs);
            buffer.Add(5 * Ms, Frame(9, 0));
            buffer.Add(50 * Ms, new double[14]);
            Assert.AreEqual(2, buffer.Late);
            buffer.Add(30 * Ms, Frame(7, 0)); // the same time again replaces it
            buffer.TryGetPoses(60 * Ms, shownRows, out _);
            Assert.AreEqual(7.0, shownRows[0]);
            buffer.Clear();
            Assert.IsFalse(buffer.TryGetPoses(60 * Ms, shownRows, out _));
        }

        [Test]
        public void BodiesThatDivergedStayWhatTheyAreAndOthersAreShown()
        {
            double[] a = new double[14];
            double[] b = new double[14];
            Frame(0, 0).CopyTo(a, 7);
            Frame(1, 1).CopyTo(b, 7);
            for (int k = 0; k < 7; k++) a[k] = b[k] = double.NaN;
            double[] target = new double[14];
            PoseBuffer.Interpolate(a, b, 0.5, target);
            Assert.IsTrue(double.IsNaN(target[0]));
            Assert.AreEqual(0.5, target[7], 1e-12);
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            PoseBuffer buffer = new PoseBuffer();
            double[] frame = new double[7 * 300];
            for (int i = 0; i < 300; i++) frame[7 * i + 3] = 1;
            double[] target = new double[frame.Length];
            for (int i = 0; i < 20; i++) buffer.Add(i * Ms, frame);
            buffer.TryGetPoses(40 * Ms, target, out _);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 20; i < 1020; i++)
            {
                buffer.Add(i * Ms, frame);
                buffer.TryGetPoses((i + 20) * Ms, target, out _);
            }
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        private static double[] Frame(double x, double angle)
        {
            double[] row = new double[7];
            new RigidTransform(new Double3(x, 0, 0), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), angle)).WriteRow(row, 0);
            return row;
        }
    }
}
