// Bytes of others: nothing but WireException, and no memory for what the bytes only claim.
using System;
using System.Collections.Generic;
using System.Linq;
using NUnit.Framework;

namespace IrisSession.Protocol.Tests
{
    [TestFixture]
    public class HostileTests
    {
        // Of an exception with its stack trace, and for each byte of the message: a double of an array has one at least, an
        // element that is a map of no entries has one, too, and is an object with strings and arrays.
        const long AllocatedAtMost = 40_000, AllocatedPerByte = 400;

        static List<Vector> Golden => Vectors.All.Where(each => !each.IsRefused && !each.IsDerived).ToList();

        [Test]
        public void EveryTruncationIsRefused()
        {
            foreach (Vector each in Golden)
            {
                var reader = new WireReader();
                WireValue into = each.Type == "PatchOp[]" ? null : Vectors.Create(each.Type);
                for (int n = 0; n < each.Bytes.Length && into != null; n += 1 + n / 64)
                {
                    reader.Reset(each.Bytes, 0, n);
                    Assert.IsFalse(IsRead(reader, into), "{0} cut to {1} bytes", each.Name, n);
                }
            }
        }

        [Test]
        public void MutationsAreReadOrRefused()
        {
            int rounds = int.Parse(System.Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "4000");
            List<Vector> vectors = Golden.Where(each => each.Type != "PatchOp[]").ToList();
            Dictionary<string, WireValue> present = vectors.Select(each => each.Type).Distinct().ToDictionary(type => type, Vectors.Create);
            var random = new Random(34);
            var reader = new WireReader();
            for (int i = 0; i < rounds; i++)
            {
                Vector each = vectors[random.Next(vectors.Count)];
                byte[] bytes = Mutate(each.Bytes, random);
                reader.Reset(bytes, 0, bytes.Length);
                try
                {
                    if (i % 2 == 0) IsRead(reader, present[each.Type]);
                    else IsRead(reader, Vectors.Create(each.Type));
                }
                catch (Exception error)
                {
                    Assert.Fail("{0}: {1} {2}", each.Name, BitConverter.ToString(bytes).Replace("-", ""), error);
                }
            }
        }

        [TestCase("Presence", "ddffffffff")] // elements of the message
        [TestCase("Presence", "930000dd00ffffff")] // structs
        [TestCase("Snapshot", "81ac7061727469636970616e7473dd00ffffff")]
        [TestCase("Lease", "81a777656967687473dd00ffffff")] // numbers
        [TestCase("Lease", "81a57175657565dd00ffffff")] // strings
        [TestCase("Refused", "81b2737570706f727465645f76657273696f6e73dd00ffffff")] // integers
        [TestCase("Feedback", "81a872656a6563746564df00ffffff")] // counts
        [TestCase("Welcome", "81ac726573756d655f746f6b656ec600ffffff")] // bytes
        [TestCase("Lease", "81a6686f6c646572db00ffffff")] // a string
        [TestCase("Lease", "81db00ffffff")] // a key
        [TestCase("Lease", "81a178df00ffffff")] // unknown
        public void StatedLengthsAllocateNothing(string type, string digits)
        {
            byte[] bytes = Enumerable.Range(0, digits.Length / 2).Select(i => Convert.ToByte(digits.Substring(2 * i, 2), 16)).ToArray();
            var reader = new WireReader(bytes);
            Assert.IsFalse(IsRead(reader, Vectors.Create(type))); // which measures
        }

        // Whether it is a message. Throws what is not a WireException, and for memory beyond what the bytes hold.
        static bool IsRead(WireReader reader, WireValue into)
        {
            int from = reader.Position;
            long before = GC.GetAllocatedBytesForCurrentThread();
            bool good = true;
            try
            {
                reader.ReadInto(into);
                reader.ExpectEnd();
            }
            catch (WireException) { good = false; }
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.LessOrEqual(allocated, AllocatedAtMost + AllocatedPerByte * (reader.Position - from));
            return good;
        }

        static byte[] Mutate(byte[] bytes, Random random)
        {
            List<byte> changed = bytes.ToList();
            for (int n = random.Next(1, 6); n > 0; n--)
            {
                int at = random.Next(changed.Count + 1);
                switch (random.Next(5))
                {
                    case 0: changed.Insert(at, (byte)random.Next(256)); break;
                    case 1: changed.Insert(at, (byte)random.Next(0xc0, 0x100)); break;
                    case 2: if (at < changed.Count) changed.RemoveAt(at); break;
                    case 3: if (at < changed.Count) changed[at] = (byte)random.Next(256); break;
                    default: // a part again, elsewhere
                        if (changed.Count == 0) break;
                        int from = random.Next(changed.Count);
                        changed.InsertRange(at, changed.GetRange(from, Math.Min(random.Next(1, 20), changed.Count - from)));
                        break;
                }
            }
            return changed.ToArray();
        }
    }
}
