using System;
using System.Collections.Generic;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class CloudTests
    {
        private static List<Json> Frames { get { return Golden.Load("cloud")["frames"].Items; } }

        [Test]
        public void GoldenFrames()
        {
            Cloud cloud = new Cloud();
            foreach (Json frame in Frames)
            {
                byte[] bytes = Golden.FromHex(frame["hex"].Text);
                cloud.Decode(bytes, 0, bytes.Length);
                Assert.AreEqual(frame["positions"].Items.Count, cloud.Count);
                for (int i = 0; i < cloud.Count; i++)
                {
                    Double3 p = cloud.GetPosition(i);
                    Assert.AreEqual(frame["positions"].Items[i].Doubles(), new[] { p.X, p.Y, p.Z });
                    int color = cloud.Points[4 * i + 3];
                    double[] rgb = { Math.Round((color >> 11) * 255 / 31.0), Math.Round(((color >> 5) & 63) * 255 / 63.0), Math.Round((color & 31) * 255 / 31.0) };
                    Assert.AreEqual(frame["colors"].Items[i].Doubles(), rgb);
                }
                double error = frame["error_m"].Double;
                Assert.AreEqual(double.IsNaN(error) ? float.PositiveInfinity : (float)error, cloud.ErrorM);
                Assert.AreEqual((float)frame["voxel_m"].Double, cloud.VoxelM);
            }
        }

        [TestCase(0, 2)] // another format
        [TestCase(1, 1)] // flags
        [TestCase(2, 0xd8)] // a lattice of 2^-40 m
        [TestCase(3, 1)] // reserved bytes
        [TestCase(4, 23)] // another number of points
        [TestCase(7, 0x80)] // 2^31 points
        [TestCase(11, 0x7f)] // an origin far away
        [TestCase(11, 0x80)] // the lowest of all
        [TestCase(23, 0xbf)] // an error below zero
        [TestCase(27, 0xff)] // voxels of no size
        public void RefusedFramesChangeNothing(int at, int value)
        {
            byte[] frame = Golden.FromHex(Frames[0]["hex"].Text);
            Cloud cloud = new Cloud();
            cloud.Decode(frame, 0, frame.Length);
            int count = cloud.Count;
            for (int length = 0; length < frame.Length; length++) Assert.Throws<DecodeException>(() => cloud.Decode(frame, 0, length));
            Assert.AreNotEqual(value, frame[at]);
            frame[at] = (byte)value;
            Assert.Throws<DecodeException>(() => cloud.Decode(frame, 0, frame.Length));
            Assert.AreEqual(count, cloud.Count);
        }

        [Test]
        public void StatedPointsAreNotAllocated()
        {
            byte[] frame = Golden.FromHex(Frames[0]["hex"].Text);
            frame[6] = 0x1f; // two million points
            Cloud cloud = new Cloud();
            Assert.Throws<DecodeException>(() => cloud.Decode(frame, 0, frame.Length));
            long before = GC.GetAllocatedBytesForCurrentThread();
            Assert.Throws<DecodeException>(() => cloud.Decode(frame, 0, frame.Length));
            Assert.LessOrEqual(GC.GetAllocatedBytesForCurrentThread() - before, 100000);
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            byte[] frame = Golden.FromHex(Frames[0]["hex"].Text);
            Cloud cloud = new Cloud();
            cloud.Decode(frame, 0, frame.Length);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 1000; i++) cloud.Decode(frame, 0, frame.Length);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }
    }
}
