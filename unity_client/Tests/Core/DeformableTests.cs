using System;
using System.Collections.Generic;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class DeformableTests
    {
        private static List<Json> Meshes { get { return Golden.Load("deformable")["meshes"].Items; } }

        [Test]
        public void GoldenFrames()
        {
            foreach (Json mesh in Meshes)
            {
                DeformableDecoder decoder = new DeformableDecoder(ReadTopology(Golden.FromHex(mesh["topology"].Text)), new Inflater());
                foreach (Json frame in mesh["frames"].Items)
                {
                    Decode(decoder, Golden.FromHex(frame["hex"].Text));
                    Assert.AreEqual((float)frame["bound_m"].Double, decoder.BoundM);
                    Assert.AreEqual(frame["vertices"].Items.Count * 3, decoder.Positions.Length);
                    for (int i = 0; i < decoder.Positions.Length; i++)
                    {
                        double value = frame["vertices"].Items[i / 3].Items[i % 3].Double;
                        float read = decoder.Positions[i];
                        if (double.IsNaN(value)) Assert.IsTrue(float.IsNaN(read) || float.IsInfinity(read));
                        else Assert.AreEqual(value, (double)read, mesh["name"].Text + " " + frame["name"].Text);
                    }
                }
            }
        }

        [TestCase(0, 1)] // another format
        [TestCase(1, 2)] // other flags
        [TestCase(2, 5)] // five planes
        [TestCase(2, 2)] // another number of planes
        [TestCase(3, 0xd8)] // a lattice of 2^-40 m
        [TestCase(7, 0xbf)] // a bound below zero
        [TestCase(12, 0)] // another mesh
        [TestCase(16, 30)] // escapes beyond the frame
        [TestCase(32, 7)] // planes that are no deflate
        public void RefusedFramesChangeNothing(int at, int value)
        {
            DeformableDecoder decoder = new DeformableDecoder(ReadTopology(Golden.FromHex(Meshes[0]["topology"].Text)), new Inflater());
            byte[] frame = Golden.FromHex(Meshes[0]["frames"].Items[0]["hex"].Text);
            Decode(decoder, frame);
            float[] before = (float[])decoder.Positions.Clone();
            for (int length = 0; length < frame.Length; length++) Assert.Throws<DecodeException>(() => decoder.Decode(frame, 0, length));
            Assert.AreNotEqual(value, frame[at]);
            frame[at] = (byte)value;
            Assert.Throws<DecodeException>(() => Decode(decoder, frame));
            Assert.AreEqual(before, decoder.Positions);
        }

        [Test]
        public void LargestResidualsWrap()
        {
            byte[] topology = new byte[24];
            topology[0] = topology[4] = topology[8] = topology[12] = 1; // one vertex, one row, one column
            DeformableDecoder decoder = new DeformableDecoder(ReadTopology(topology), new Inflater());
            byte[] frame = new byte[32 + 12];
            frame[0] = 2;
            frame[8] = 1;
            frame[2] = 4;
            BitConverter.GetBytes(0.5f).CopyTo(frame, 4);
            BitConverter.GetBytes(decoder.Topology.Identity).CopyTo(frame, 12);
            BitConverter.GetBytes(-1).CopyTo(frame, 24); // origin y
            for (int i = 32; i < frame.Length; i++) frame[i] = 0xff;
            Decode(decoder, frame);
            Assert.AreEqual(new[] { -2147483648f, 2147483648f, -2147483648f }, decoder.Positions);
            BitConverter.GetBytes(float.PositiveInfinity).CopyTo(frame, 4);
            Assert.Throws<DecodeException>(() => Decode(decoder, frame));
        }

        [Test]
        public void EscapesMustAscend()
        {
            byte[] topology = new byte[24];
            topology[0] = topology[12] = 1;
            topology[4] = topology[8] = 2;
            DeformableDecoder decoder = new DeformableDecoder(ReadTopology(topology), new Inflater());
            byte[] frame = new byte[64];
            frame[0] = 2;
            frame[8] = frame[16] = 2;
            BitConverter.GetBytes(0.5f).CopyTo(frame, 4);
            BitConverter.GetBytes(decoder.Topology.Identity).CopyTo(frame, 12);
            frame[48] = 1;
            BitConverter.GetBytes(7f).CopyTo(frame, 52);
            Decode(decoder, frame);
            Assert.AreEqual(7f, decoder.Positions[3]);
            frame[48] = 0;
            Assert.Throws<DecodeException>(() => Decode(decoder, frame));
            frame[48] = 2;
            Assert.Throws<DecodeException>(() => Decode(decoder, frame));
        }

        [TestCase(0, 2)] // another format
        [TestCase(1, 2)] // another plan
        [TestCase(2, 2)] // other flags
        [TestCase(4, 0)] // no vertex
        [TestCase(7, 0x80)] // 2^31 vertices
        [TestCase(19, 0x80)] // 2^31 faces
        [TestCase(8, 7)] // rows that do not fit
        [TestCase(24, 30)] // a face beyond the vertices
        public void RefusedTopologies(int at, int value)
        {
            byte[] topology = Golden.FromHex(Meshes[0]["topology"].Text);
            ReadTopology(topology);
            Assert.AreNotEqual(value, topology[at]);
            topology[at] = (byte)value;
            Assert.Throws<DecodeException>(() => ReadTopology(topology));
        }

        [Test]
        public void ParentsComeBefore()
        {
            byte[] tree = Golden.FromHex(Meshes.Find(mesh => mesh["topology"].Text.StartsWith("0101"))["topology"].Text);
            DeformableTopology topology = ReadTopology(tree);
            tree[24 + (topology.Order == null ? 0 : 4 * topology.VertexCount)] = 1; // of the first place
            Assert.Throws<DecodeException>(() => ReadTopology(tree));
        }

        [Test]
        public void OrdersHaveEveryVertexOnce()
        {
            byte[] two = new byte[32];
            two[0] = two[2] = two[8] = 1;
            two[4] = two[12] = 2;
            Assert.Throws<DecodeException>(() => ReadTopology(two));
            two[24] = 1;
            Assert.AreEqual(new[] { 1, 0 }, ReadTopology(two).Order);
        }

        [Test]
        public void DamagedBytesGiveOneException()
        {
            Random random = new Random(29);
            Inflater inflater = new Inflater();
            int rounds = int.Parse(Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "4000");
            for (int round = 0; round < rounds; round++)
            {
                Json mesh = Meshes[random.Next(Meshes.Count)];
                byte[] topology = Golden.FromHex(mesh["topology"].Text);
                byte[] frame = Golden.FromHex(mesh["frames"].Items[random.Next(mesh["frames"].Items.Count)]["hex"].Text);
                try
                {
                    DeformableDecoder decoder = new DeformableDecoder(ReadTopology(round % 2 == 0 ? topology : RigidDecoderTests.Damage(random, topology)), inflater);
                    Decode(decoder, RigidDecoderTests.Damage(random, frame));
                }
                catch (DecodeException)
                {
                }
            }
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            Json mesh = Meshes[0];
            DeformableDecoder decoder = new DeformableDecoder(ReadTopology(Golden.FromHex(mesh["topology"].Text)), new Inflater());
            List<byte[]> frames = new List<byte[]>();
            foreach (Json frame in mesh["frames"].Items) frames.Add(Golden.FromHex(frame["hex"].Text));
            foreach (byte[] frame in frames) Decode(decoder, frame);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 1000; i++) Decode(decoder, frames[i % frames.Count]);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        private static DeformableTopology ReadTopology(byte[] bytes)
        {
            return new DeformableTopology(bytes, 0, bytes.Length);
        }

        private static void Decode(DeformableDecoder decoder, byte[] frame)
        {
            decoder.Decode(frame, 0, frame.Length);
        }
    }
}
