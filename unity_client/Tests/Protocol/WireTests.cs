using NUnit.Framework;

namespace IrisSession.Protocol.Tests
{
    [TestFixture]
    public class WireTests
    {
        [TestCase(0L, 1)]
        [TestCase(-33L, 2)]
        [TestCase(long.MaxValue, 9)]
        public void IntegersAreWrittenInTheirShortestForm(long value, int bytes)
        {
            var writer = new WireWriter();
            writer.Write(value);
            Assert.AreEqual(bytes, writer.Length);
            Assert.AreEqual(value, new WireReader(writer.ToArray()).ReadLong());
        }
    }
}
