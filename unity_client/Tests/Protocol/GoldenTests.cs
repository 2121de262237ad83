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
            foreach (Vector each in Vectors.All.Where(each => !each.IsRefused))
                CollectionAssert.AreEqual(each.Canonical, Vectors.ReadAndWrite(each.Type, each.Bytes), each.Name);
        }

        [Test]
        public void RefusedVectorsThrow()
        {
            foreach (Vector each in Vectors.All.Where(each => each.IsRefused))
                Assert.Throws<WireException>(() => Vectors.ReadAndWrite(each.Type, each.Bytes), each.Name);
        }

        [Test]
        public void AnObjectThatHasBeenReadBeforeKeepsNothingOfIt()
        {
            foreach (var group in Vectors.All.Where(each => each.Type != "PatchOp[]").GroupBy(each => each.Type))
            {
                WireValue present = Vectors.Create(group.Key);
                List<Vector> vectors = group.ToList();
                var random = new Random(7);
                for (int i = 0; i < 2 * vectors.Count; i++)
                {
                    Vector each = vectors[random.Next(vectors.Count)];
                    if (each.IsRefused) Assert.Throws<WireException>(() => Vectors.ReadAndWrite(each.Type, each.Bytes, present));
                    else CollectionAssert.AreEqual(each.Canonical, Vectors.ReadAndWrite(each.Type, each.Bytes, present), each.Name);
                }
            }
        }

        [Test]
        public void NewObjectsHaveTheDefaultsOfTheSchema()
        {
            foreach (Vector each in Vectors.All.Where(each => each.Name.EndsWith(" defaults")))
                CollectionAssert.AreEqual(each.Canonical, Vectors.Create(each.Type).Encode(), each.Name);
        }
    }
}
