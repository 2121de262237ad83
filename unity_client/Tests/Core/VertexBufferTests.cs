using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class VertexBufferTests
    {
        private const long Ms = 1_000_000;

        [Test]
        public void VerticesAreInterpolatedAndNeverGoBack()
        {
            VertexBuffer buffer = new VertexBuffer(3);
            float[] shown = new float[3];
            Assert.IsFalse(buffer.TryGetVertices(0, shown));
            for (int i = 0; i < 5; i++) buffer.Add(10 * i * Ms, new[] { (float)i, 2f * i, 0f });
            Assert.IsTrue(buffer.TryGetVertices(35 * Ms, shown));
            Assert.AreEqual(new[] { 3.5f, 7f, 0f }, shown);
            buffer.TryGetVertices(32 * Ms, shown);
            Assert.AreEqual(3.5f, shown[0]);
            buffer.TryGetVertices(90 * Ms, shown);
            Assert.AreEqual(4f, shown[0]);
            buffer.Add(5 * Ms, new float[3]);
            buffer.Add(50 * Ms, new float[6]);
            Assert.AreEqual(2, buffer.Late);
            Assert.IsFalse(buffer.TryGetVertices(90 * Ms, new float[6]));
            buffer.Clear();
            buffer.Add(1 * Ms, new float[6]);
            Assert.IsTrue(buffer.TryGetVertices(0, new float[6])); // before the first frame: that frame
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            VertexBuffer buffer = new VertexBuffer();
            float[] frame = new float[3000];
            for (int i = 0; i < 20; i++) buffer.Add(i * Ms, frame);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 20; i < 1020; i++)
            {
                buffer.Add(i * Ms, frame);
                buffer.TryGetVertices(i * Ms - Ms / 2, frame);
            }
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }
    }
}
