using System;
using System.Collections.Generic;
using System.Linq;
using NUnit.Framework;

namespace IrisSession.Protocol.Tests
{
    [TestFixture]
    public class GoldenTests
    {
        [Test]
        public void VectorsAreReadAndWrittenByteForByte()
        {
            foreach (Vector each in Vectors.All.Where(each => !each.IsRefused)) AssertReads(each, null);
        }

        [Test]
        public void RefusedVectorsThrow()
        {
            foreach (Vector each in Vectors.All.Where(each => each.IsRefused)) AssertRefuses(each, null);
        }

        [Test]
        public void AnObjectThatHasBeenReadBeforeKeepsNothingOfIt()
        {
            foreach (var group in Vectors.All.Where(each => each.Type != "PatchOp[]").GroupBy(each => each.Type))
            {
                WireValue present = Vectors.Create(group.Key);
                List<Vector> vectors = group.ToList();
                var random = new Random(7);
                for (int i = 0; i < 60; i++)
                {
                    Vector each = vectors[random.Next(vectors.Count)];
                    if (each.IsRefused) AssertRefuses(each, present);
                    else AssertReads(each, present);
                }
            }
        }

        static void AssertReads(Vector each, WireValue into)
        {
            byte[] written = Vectors.ReadAndWrite(each.Type, each.Bytes, into);
            if (!written.SequenceEqual(each.Canonical)) CollectionAssert.AreEqual(each.Canonical, written, each.Name);
        }

        static void AssertRefuses(Vector each, WireValue into)
        {
            try { Vectors.ReadAndWrite(each.Type, each.Bytes, into); }
            catch (WireException) { return; }
            Assert.Fail("{0} is read", each.Name);
        }

        [Test]
        public void NewObjectsHaveTheDefaultsOfTheSchema()
        {
            foreach (Vector each in Vectors.All.Where(each => each.Name.EndsWith(" defaults")))
                CollectionAssert.AreEqual(each.Canonical, Vectors.Create(each.Type).Encode(), each.Name);
        }
    }
}
