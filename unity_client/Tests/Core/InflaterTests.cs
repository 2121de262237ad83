// The decoder against streams of zlib, and against damaged ones: deflate.bin in the folder IRIS_VECTORS (tools/csharp/deflate_vectors.py).
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class InflaterTests
    {
        private struct Vector
        {
            public byte[] Stream;
            public int Size;
            public byte[] Content; // null: must be refused
        }

        [Test]
        public void StreamsGiveWhatZlibGives()
        {
            Inflater inflater = new Inflater();
            int equal = 0, refused = 0;
            foreach (Vector vector in ReadVectors())
            {
                byte[] target = new byte[vector.Size + 3];
                try
                {
                    inflater.Inflate(vector.Stream, 0, vector.Stream.Length, target, vector.Size);
                    if (vector.Content == null) Assert.Fail("a stream that zlib refuses: " + Golden.ToHex(vector.Stream, 0, Math.Min(200, vector.Stream.Length)));
                    for (int i = 0; i < vector.Size; i++) if (target[i] != vector.Content[i]) Assert.Fail("byte " + i + " of " + vector.Size);
                    equal++;
                }
                catch (DecodeException error)
                {
                    if (vector.Content != null) Assert.Fail(error.Message + " " + vector.Size + " " + Golden.ToHex(vector.Stream, 0, Math.Min(200, vector.Stream.Length)));
                    refused++;
                }
                for (int i = vector.Size; i < target.Length; i++) Assert.AreEqual(0, target[i], "written behind the content");
            }
            Assert.Greater(equal, 200);
            Assert.Greater(refused, 500);
        }

        // Stored, fixed and dynamic codes of zlib, so that a few run without Python.
        [TestCase("0300", "")]
        [TestCase("4b4c4a0600", "abc")]
        [TestCase("010300fcff616263", "abc")]
        [TestCase("abaa8203" + "0000" , null)] // a stored block without its lengths
        [TestCase("07", null)] // a block of an unknown kind
        [TestCase("010300fcfe616263", null)] // lengths that differ
        [TestCase("4b0400", null)] // "a", and it ends too early
        public void SmallStreams(string stream, string content)
        {
            byte[] bytes = Golden.FromHex("ff" + stream + "ff");
            byte[] target = new byte[content == null ? 3 : content.Length];
            if (content == null)
            {
                Assert.Throws<DecodeException>(() => new Inflater().Inflate(bytes, 1, bytes.Length - 2, target, target.Length));
                return;
            }
            new Inflater().Inflate(bytes, 1, bytes.Length - 2, target, target.Length);
            Assert.AreEqual(content, System.Text.Encoding.ASCII.GetString(target));
            Assert.Throws<DecodeException>(() => new Inflater().Inflate(bytes, 1, bytes.Length - 1, target, target.Length));
            Assert.Throws<DecodeException>(() => new Inflater().Inflate(bytes, 1, bytes.Length - 3, target, target.Length));
            Assert.Throws<DecodeException>(() => new Inflater().Inflate(bytes, 1, bytes.Length - 2, new byte[9], target.Length + 1));
            if (target.Length > 0) Assert.Throws<DecodeException>(() => new Inflater().Inflate(bytes, 1, bytes.Length - 2, target, target.Length - 1));
        }

        [Test]
        public void SizesThatBytesCannotHoldAreRefusedBeforeAnythingIsAllocated()
        {
            Assert.Throws<DecodeException>(() => Inflater.CheckSize(1000, 1 << 30));
            Assert.Throws<DecodeException>(() => Inflater.CheckSize(1000, -1));
            Inflater.CheckSize(1000, 1000000);
        }

        [Test]
        public void DamagedStreamsGiveOneExceptionAndAllocateLittle()
        {
            Inflater inflater = new Inflater();
            Random random = new Random(17);
            int rounds = int.Parse(Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "3000");
            List<Vector> vectors = ReadVectors().FindAll(vector => vector.Content != null && vector.Stream.Length < 5000 && vector.Size < 70000);
            byte[] target = new byte[70000];
            byte[] bad = new byte[5000];
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int round = 0; round < rounds; round++)
            {
                Vector vector = vectors[random.Next(vectors.Count)];
                Buffer.BlockCopy(vector.Stream, 0, bad, 0, vector.Stream.Length);
                int length = random.Next(4) == 0 ? random.Next(vector.Stream.Length) : vector.Stream.Length;
                for (int i = random.Next(1, 6); i > 0; i--) bad[random.Next(vector.Stream.Length)] = (byte)random.Next(256);
                try
                {
                    inflater.Inflate(bad, 0, length, target, vector.Size);
                }
                catch (DecodeException)
                {
                }
            }
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.LessOrEqual(allocated, 4096L * rounds);
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            Inflater inflater = new Inflater();
            List<Vector> vectors = ReadVectors().FindAll(vector => vector.Content != null && vector.Stream.Length < 30000);
            byte[] target = new byte[500000];
            foreach (Vector vector in vectors) inflater.Inflate(vector.Stream, 0, vector.Stream.Length, target, vector.Size);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < vectors.Count; i++) inflater.Inflate(vectors[i].Stream, 0, vectors[i].Stream.Length, target, vectors[i].Size);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        /// <summary>Prints the speed over all large contents.</summary>
        [Test]
        [Category("Long")]
        public void Speed()
        {
            Inflater inflater = new Inflater();
            byte[] target = new byte[500000];
            double bytes = 0, seconds = 0;
            foreach (Vector vector in ReadVectors().FindAll(vector => vector.Content != null && vector.Size > 30000))
            {
                double best = double.MaxValue;
                for (int round = 0; round < 9; round++)
                {
                    Stopwatch watch = Stopwatch.StartNew();
                    inflater.Inflate(vector.Stream, 0, vector.Stream.Length, target, vector.Size);
                    best = Math.Min(best, watch.Elapsed.TotalSeconds);
                }
                bytes += vector.Size;
                seconds += best;
            }
            Console.WriteLine("deflate: " + bytes / seconds / 1e6 + " MB/s");
        }

        private static List<Vector> ReadVectors()
        {
            string folder = Environment.GetEnvironmentVariable("IRIS_VECTORS");
            if (folder == null) Assert.Ignore("the vectors are written by python -m tools.csharp test");
            List<Vector> vectors = new List<Vector>();
            using (BinaryReader reader = new BinaryReader(File.OpenRead(Path.Combine(folder, "deflate.bin"))))
            {
                byte[][] contents = new byte[reader.ReadInt32()][];
                for (int i = 0; i < contents.Length; i++) contents[i] = reader.ReadBytes(reader.ReadInt32());
                while (reader.BaseStream.Position < reader.BaseStream.Length)
                {
                    int content = reader.ReadInt32();
                    int size = reader.ReadInt32();
                    vectors.Add(new Vector { Content = content < 0 ? null : contents[content], Size = size, Stream = reader.ReadBytes(reader.ReadInt32()) });
                }
            }
            return vectors;
        }
    }
}
