using System;
using System.Collections.Generic;
using System.Diagnostics;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class RigidDecoderTests
    {
        private static List<Json> Vectors { get { return Golden.Load("golden")["rigid"].Items; } }

        [Test]
        public void GoldenFrames()
        {
            foreach (Json vector in Vectors)
            {
                RigidDecoder decoder = new RigidDecoder(vector["n_bodies"].Int);
                Apply(decoder, 1, 0, Bytes(vector));
                for (int body = 0; body < decoder.BodyCount; body++)
                {
                    Json expected = vector["poses"].Find(body.ToString());
                    for (int k = 0; k < 7; k++)
                    {
                        double value = expected == null ? double.NaN : expected.Items[k].Double;
                        double read = decoder.Poses[7 * body + k];
                        if (double.IsNaN(value)) Assert.IsFalse(read > double.NegativeInfinity && read < double.PositiveInfinity);
                        else Assert.AreEqual(value, read, 1e-12 * Math.Max(1.0, Math.Abs(value)), vector["name"].Text);
                    }
                }
                Assert.AreEqual(vector["poses"].Fields.Count == decoder.BodyCount, decoder.IsComplete);
            }
        }

        [TestCase("room of 10 x 10 x 3 m", 0, 1)] // another format
        [TestCase("room of 10 x 10 x 3 m", 1, 2)] // another layout
        [TestCase("room of 10 x 10 x 3 m", 2, 6)] // another number of bodies
        [TestCase("room of 10 x 10 x 3 m", 4, 6)] // more quantised than bodies
        [TestCase("room of 10 x 10 x 3 m", 23, 0xff)] // no rotation
        [TestCase("two of nineteen", 44, 0x81)] // a bit too many in the mask
        [TestCase("two of nineteen", 46, 0x0c)] // a bit beyond the bodies
        [TestCase("escapes", 34, 3)] // an escape that is in the mask
        [TestCase("escapes", 34, 11)] // escapes that descend
        [TestCase("escapes", 92, 12)] // an escape beyond the bodies
        public void RefusedFramesChangeNothing(string name, int at, int value)
        {
            Json vector = Find(name);
            RigidDecoder decoder = new RigidDecoder(vector["n_bodies"].Int);
            byte[] payload = Bytes(vector);
            Apply(decoder, 1, 0, payload);
            double[] before = (double[])decoder.Poses.Clone();
            Assert.AreNotEqual(value, payload[at]);
            payload[at] = (byte)value;
            Assert.Throws<DecodeException>(() => Apply(decoder, 2, 0, payload));
            Assert.AreEqual(1, decoder.StateSeq);
            Assert.AreEqual(before, decoder.Poses);
        }

        [Test]
        public void OtherLengthsAreRefused()
        {
            foreach (Json vector in Vectors)
            {
                byte[] payload = Bytes(vector);
                RigidDecoder decoder = new RigidDecoder(vector["n_bodies"].Int);
                for (int length = 0; length < payload.Length; length++) Assert.Throws<DecodeException>(() => decoder.Apply(1, 0, payload, 0, length));
                byte[] longer = new byte[payload.Length + 1];
                payload.CopyTo(longer, 0);
                Assert.Throws<DecodeException>(() => Apply(decoder, 1, 0, longer));
            }
        }

        [Test]
        public void BodiesAreValidInAFrameOrSinceItsBase()
        {
            RigidDecoder decoder = new RigidDecoder(19);
            byte[] two = Bytes(Find("two of nineteen"));
            Assert.IsFalse(Apply(decoder, 5, 3, two));
            Assert.IsTrue(decoder.LoadKeyframe(4, new byte[56 * 19], 0, 56 * 19));
            Assert.AreEqual(0.0, decoder.Poses[0]);
            Assert.AreEqual(9.9, decoder.Poses[7 * 7], 1e-3);
            Assert.IsTrue(Apply(decoder, 6, 5, two));
            Assert.IsFalse(Apply(decoder, 40, 30, two));
            Assert.IsFalse(Apply(decoder, 39, 0, two));
            Assert.AreEqual(1, decoder.StaleFrames);
            Assert.Throws<DecodeException>(() => decoder.LoadKeyframe(50, new byte[56], 0, 56));
            Assert.Throws<DecodeException>(() => Apply(decoder, 50, 51, two));
            Assert.Throws<DecodeException>(() => new RigidDecoder(1 << 16));
        }

        [Test]
        public void DamagedFramesGiveOneException()
        {
            Random random = new Random(23);
            int rounds = int.Parse(Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "4000");
            for (int round = 0; round < rounds; round++)
            {
                Json vector = Vectors[random.Next(Vectors.Count)];
                RigidDecoder decoder = new RigidDecoder(vector["n_bodies"].Int);
                byte[] payload = Damage(random, Bytes(vector));
                try
                {
                    Apply(decoder, 1, 0, payload);
                }
                catch (DecodeException)
                {
                    Assert.AreEqual(0, decoder.StateSeq);
                }
            }
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            byte[] payload = MakeFrame(300);
            RigidDecoder decoder = new RigidDecoder(300);
            for (long seq = 1; seq < 100; seq++) Apply(decoder, seq, 0, payload);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (long seq = 100; seq < 10100; seq++) Apply(decoder, seq, seq - 1, payload);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
            if (Environment.GetEnvironmentVariable("IRIS_BENCH") == null) return;
            Stopwatch watch = Stopwatch.StartNew();
            for (long seq = 10100; seq < 20100; seq++) Apply(decoder, seq, seq - 1, payload);
            Console.WriteLine("rigid frame of 300 bodies: " + watch.Elapsed.TotalMilliseconds / 10 + " us");
        }

        /// <summary>Return a frame with every one of `count` bodies at its own place.</summary>
        internal static byte[] MakeFrame(int count)
        {
            byte[] payload = new byte[20 + 12 * count];
            payload[0] = 2;
            BitConverter.GetBytes((ushort)count).CopyTo(payload, 2);
            BitConverter.GetBytes((ushort)count).CopyTo(payload, 4);
            for (int i = 0; i < 3 * count; i++) BitConverter.GetBytes((uint)(i * 31) | ((8191u + (uint)i % 500) << 18)).CopyTo(payload, 20 + 4 * i);
            return payload;
        }

        /// <summary>Return a copy that is cut off or has other bytes.</summary>
        internal static byte[] Damage(Random random, byte[] bytes)
        {
            byte[] bad = (byte[])bytes.Clone();
            if (bad.Length > 0) for (int i = random.Next(1, 4); i > 0; i--) bad[random.Next(Math.Min(bad.Length, random.Next(2) == 0 ? 64 : bad.Length))] = (byte)random.Next(256);
            if (random.Next(5) == 0) Array.Resize(ref bad, random.Next(bad.Length + 8));
            return bad;
        }

        private static bool Apply(RigidDecoder decoder, long seq, long baseSeq, byte[] payload)
        {
            return decoder.Apply(seq, baseSeq, payload, 0, payload.Length);
        }

        private static byte[] Bytes(Json vector) { return Golden.FromHex(vector["hex"].Text); }

        private static Json Find(string name) { return Vectors.Find(vector => vector["name"].Text == name); }
    }
}
