// The decoder against frames of libzstd, and against damaged ones: zstd.bin in the folder IRIS_VECTORS (tools/csharp/zstd_vectors.py).
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ZstdDecoderTests
    {
        private struct Vector
        {
            public int Verdict;
            public byte[] Frame;
            public byte[] Content;
        }

        private const int Equal = 0;
        private const int Refused = 1; // others: equal or refused

        [Test]
        public void FramesOfLibzstdHaveTheirContent()
        {
            ZstdDecoder decoder = new ZstdDecoder();
            int equal = 0, refused = 0;
            foreach (Vector vector in ReadVectors())
            {
                byte[] target = new byte[vector.Content.Length + 3];
                try
                {
                    decoder.Decode(vector.Frame, 0, vector.Frame.Length, target, vector.Content.Length);
                    if (vector.Verdict == Refused) Assert.Fail("a frame that libzstd refuses: " + Golden.ToHex(vector.Frame, 0, Math.Min(200, vector.Frame.Length)));
                    for (int i = 0; i < vector.Content.Length; i++) if (target[i] != vector.Content[i]) Assert.Fail("byte " + i + " of " + vector.Content.Length);
                    for (int i = vector.Content.Length; i < target.Length; i++) Assert.AreEqual(0, target[i], "written behind the content");
                    equal++;
                }
                catch (DecodeException error)
                {
                    if (vector.Verdict == Equal) Assert.Fail(error.Message + " " + vector.Content.Length);
                    refused++;
                }
            }
            Assert.Greater(equal, 200);
            Assert.Greater(refused, 100);
        }

        // An empty frame; raw, repeated and compressed literals of libzstd 1.5, so that a few run without Python.
        [TestCase("28b52ffd2000010000", "")]
        [TestCase("28b52ffd2003190000616263", "abc")]
        [TestCase("28b52ffd20042300007a", "zzzz")]
        public void SmallFrames(string frame, string content)
        {
            byte[] bytes = Golden.FromHex("ff" + frame + "ff");
            byte[] target = new byte[content.Length];
            new ZstdDecoder().Decode(bytes, 1, bytes.Length - 2, target, target.Length);
            Assert.AreEqual(content, System.Text.Encoding.ASCII.GetString(target));
            Assert.Throws<DecodeException>(() => new ZstdDecoder().Decode(bytes, 1, bytes.Length - 1, target, target.Length));
            Assert.Throws<DecodeException>(() => new ZstdDecoder().Decode(bytes, 1, bytes.Length - 3, target, target.Length));
            Assert.Throws<DecodeException>(() => new ZstdDecoder().Decode(bytes, 1, bytes.Length - 2, new byte[9], 9));
        }

        [TestCase("28b52ffd2005210000" + "01020304", 5)] // a block that holds less than is stated
        [TestCase("28b52ffda000000040" + "010000", 1 << 30)] // a size that no block holds
        [TestCase("28b52ffda000000200" + "5d000000ffffff54230334ffff80", 131072)] // 98,047 sequences of the longest matches, in 23 bytes
        [TestCase("", 0)]
        public void RefusedFrames(string frame, int size)
        {
            byte[] bytes = Golden.FromHex(frame);
            Assert.Throws<DecodeException>(() =>
            {
                ZstdDecoder.CheckFrame(bytes, 0, bytes.Length, size);
                new ZstdDecoder().Decode(bytes, 0, bytes.Length, new byte[size], size);
            });
        }

        [Test]
        public void DamagedFramesGiveOneExceptionAndAllocateLittle()
        {
            ZstdDecoder decoder = new ZstdDecoder();
            Random random = new Random(17);
            int rounds = int.Parse(Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "4000");
            List<Vector> vectors = ReadVectors().FindAll(vector => vector.Verdict == Equal && vector.Frame.Length < 5000 && vector.Content.Length < 70000);
            byte[] target = new byte[70000];
            long before = GC.GetAllocatedBytesForCurrentThread();
            byte[] bad = new byte[5000];
            for (int round = 0; round < rounds; round++)
            {
                Vector vector = vectors[random.Next(vectors.Count)];
                Buffer.BlockCopy(vector.Frame, 0, bad, 0, vector.Frame.Length);
                int length = random.Next(4) == 0 ? random.Next(vector.Frame.Length) : vector.Frame.Length;
                for (int i = random.Next(1, 6); i > 0; i--) bad[random.Next(vector.Frame.Length)] = (byte)random.Next(256);
                try
                {
                    decoder.Decode(bad, 0, length, target, vector.Content.Length);
                }
                catch (DecodeException)
                {
                }
            }
            Assert.LessOrEqual(GC.GetAllocatedBytesForCurrentThread() - before, 4096L * rounds);
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            ZstdDecoder decoder = new ZstdDecoder();
            List<Vector> vectors = ReadVectors().FindAll(vector => vector.Verdict == Equal && vector.Frame.Length < 30000);
            byte[] target = new byte[500000];
            foreach (Vector vector in vectors) decoder.Decode(vector.Frame, 0, vector.Frame.Length, target, vector.Content.Length);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < vectors.Count; i++) decoder.Decode(vectors[i].Frame, 0, vectors[i].Frame.Length, target, vectors[i].Content.Length);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        /// <summary>Prints the speed for every large content, when IRIS_BENCH is set.</summary>
        [Test]
        public void Speed()
        {
            if (Environment.GetEnvironmentVariable("IRIS_BENCH") == null) Assert.Ignore("IRIS_BENCH is not set");
            ZstdDecoder decoder = new ZstdDecoder();
            byte[] target = new byte[500000];
            double bytes = 0, seconds = 0;
            foreach (Vector vector in ReadVectors().FindAll(vector => vector.Verdict == Equal && vector.Content.Length > 30000))
            {
                double best = double.MaxValue;
                for (int round = 0; round < 9; round++)
                {
                    Stopwatch watch = Stopwatch.StartNew();
                    decoder.Decode(vector.Frame, 0, vector.Frame.Length, target, vector.Content.Length);
                    best = Math.Min(best, watch.Elapsed.TotalSeconds);
                }
                bytes += vector.Content.Length;
                seconds += best;
                if (Environment.GetEnvironmentVariable("IRIS_BENCH") == "2") Console.WriteLine(vector.Content.Length + " from " + vector.Frame.Length + ": " + vector.Content.Length / best / 1e6 + " MB/s");
            }
            Console.WriteLine("zstd: " + bytes / seconds / 1e6 + " MB/s");
        }

        private static List<Vector> ReadVectors()
        {
            string folder = Environment.GetEnvironmentVariable("IRIS_VECTORS");
            if (folder == null || !File.Exists(Path.Combine(folder, "zstd.bin"))) Assert.Ignore("IRIS_VECTORS names no folder with zstd.bin");
            List<Vector> vectors = new List<Vector>();
            using (BinaryReader reader = new BinaryReader(File.OpenRead(Path.Combine(folder, "zstd.bin"))))
            {
                byte[][] contents = new byte[reader.ReadInt32()][];
                for (int i = 0; i < contents.Length; i++) contents[i] = reader.ReadBytes(reader.ReadInt32());
                while (reader.BaseStream.Position < reader.BaseStream.Length)
                {
                    int verdict = reader.ReadInt32();
                    byte[] content = contents[reader.ReadInt32()];
                    vectors.Add(new Vector { Verdict = verdict, Content = content, Frame = reader.ReadBytes(reader.ReadInt32()) });
                }
            }
            return vectors;
        }
    }
}
