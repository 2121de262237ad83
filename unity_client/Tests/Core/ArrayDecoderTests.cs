using System;
using System.Collections.Generic;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ArrayDecoderTests
    {
        private static List<Json> Assets { get { return Golden.Load("arrays")["assets"].Items; } }

        private static List<Json> Malformed { get { return Golden.Load("arrays")["malformed"].Items; } }

        [Test]
        public void GoldenAssets()
        {
            ArrayDecoder decoder = new ArrayDecoder();
            foreach (Json asset in Assets)
            {
                string where = asset["name"].Text;
                ArrayAsset decoded = decoder.Decode(Golden.FromHex(asset["hex"].Text));
                Assert.AreEqual(asset["kind"].Text, decoded.Kind, where);
                Assert.AreEqual(asset["arrays"].Fields.Count, decoded.Count, where);
                double ulp = decoded.MaxError > 0 ? Math.Pow(2, -23) : 0;
                foreach (KeyValuePair<string, Json> field in asset["arrays"].Fields)
                {
                    DecodedArray array = decoded.Find(field.Key);
                    Assert.AreEqual(field.Value["shape"].Doubles(), Array.ConvertAll(array.Shape, n => (double)n), where);
                    List<Json> values = field.Value["values"].Items;
                    Assert.AreEqual(values.Count, array.Data.Length, where);
                    for (int i = 0; i < values.Count; i++)
                    {
                        double read = Convert.ToDouble(array.Data.GetValue(i));
                        if (values[i].IsNull) Assert.IsTrue(double.IsNaN(read) || double.IsInfinity(read), where);
                        else Assert.AreEqual(values[i].Double, read, ulp * Math.Max(1, Math.Abs(read)), where + " " + field.Key + " " + i);
                    }
                }
            }
        }

        [Test]
        public void RefusedAssets()
        {
            ArrayDecoder decoder = new ArrayDecoder();
            foreach (Json asset in Malformed)
            {
                byte[] bytes = Golden.FromHex(asset["hex"].Text);
                if (asset["name"].Text == "another kind") Assert.AreEqual("image", decoder.Decode(bytes).Kind);
                else Assert.Throws<DecodeException>(() => decoder.Decode(bytes), asset["name"].Text);
            }
        }

        [Test]
        public void WhatIsAskedForMustFit()
        {
            ArrayAsset mesh = new ArrayDecoder().Decode(Golden.FromHex(Assets.Find(asset => asset["name"].Text == "a mesh, exact")["hex"].Text));
            Assert.AreEqual(96, mesh.RequireFloats("position", ArrayAsset.Any, 3).Length);
            Assert.AreEqual(126, mesh.RequireIndices("index", 32, ArrayAsset.Any, 3).Length);
            Assert.Throws<DecodeException>(() => mesh.RequireIndices("index", 31, ArrayAsset.Any, 3));
            Assert.Throws<DecodeException>(() => mesh.RequireIndices("position", 32, ArrayAsset.Any, 3));
            Assert.Throws<DecodeException>(() => mesh.RequireFloats("position", ArrayAsset.Any, 2));
            Assert.Throws<DecodeException>(() => mesh.RequireFloats("index", ArrayAsset.Any, 3));
            Assert.Throws<DecodeException>(() => mesh.RequireBytes("position", ArrayAsset.Any, 3));
            Assert.Throws<DecodeException>(() => mesh.RequireFloats("color", ArrayAsset.Any, 4));
            ArrayAsset plain = new ArrayDecoder().Decode(Golden.FromHex(Assets[0]["hex"].Text));
            Assert.AreEqual(12, plain.RequireBytes("u1", 4, 3).Length);
            Assert.Throws<DecodeException>(() => plain.RequireBytes("i1", 4, 3));
        }

        [Test]
        public void MoreThanTheLimitIsNotRead()
        {
            byte[] bytes = Golden.FromHex(Assets[0]["hex"].Text);
            new ArrayDecoder().Decode(bytes, 144);
            Assert.Throws<DecodeException>(() => new ArrayDecoder().Decode(bytes, 143));
        }

        [TestCase("deflate")]
        [TestCase("none")]
        public void WhatBytesCannotHoldIsNotAllocated(string codec)
        {
            ArrayInfo info = new ArrayInfo { Name = "pixels", Dtype = "u1", Shape = new[] { 1L << 29 }, Bytes = 10, Codec = codec };
            byte[] header = new ArrayHeader { Kind = "image", Arrays = new[] { info } }.Encode();
            byte[] asset = new byte[8 + header.Length + 10];
            System.Text.Encoding.ASCII.GetBytes("IRA1").CopyTo(asset, 0);
            BitConverter.GetBytes(header.Length).CopyTo(asset, 4);
            header.CopyTo(asset, 8);
            ArrayDecoder decoder = new ArrayDecoder();
            Assert.Throws<DecodeException>(() => decoder.Decode(asset));
            long before = GC.GetAllocatedBytesForCurrentThread();
            Assert.Throws<DecodeException>(() => decoder.Decode(asset));
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.LessOrEqual(allocated, 100000L);
        }

        [Test]
        public void DamagedAssetsGiveOneExceptionAndAllocateNoMoreThanTheirBytesCanHold()
        {
            Random random = new Random(31);
            ArrayDecoder decoder = new ArrayDecoder();
            int rounds = int.Parse(System.Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "2000");
            byte[][] assets = Assets.ConvertAll(asset => Golden.FromHex(asset["hex"].Text)).ToArray();
            for (int round = 0; round < rounds; round++)
            {
                byte[] bad = RigidDecoderTests.Damage(random, assets[random.Next(assets.Length)]);
                long before = GC.GetAllocatedBytesForCurrentThread();
                try
                {
                    decoder.Decode(bad);
                }
                catch (DecodeException)
                {
                }
                long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
                Assert.LessOrEqual(allocated, 3 * 1032L * bad.Length + 65536);
            }
        }
    }
}
