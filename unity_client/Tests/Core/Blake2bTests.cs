using System.Text;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class Blake2bTests
    {
        [TestCase(0, 16, "", "cae66941d9efbd404e4d88758ea67670")]
        [TestCase(1, 64, "", "2fa3f686df876995167e7c2e5d74c4c7b6e48f8068fe0e44208344d480f7904c36963e44115fe3eb2a3ac8694c28bcb4f5a0f3276f2e79487d8219057a506e4b")]
        [TestCase(128, 16, "", "a74787004ef589e31149183900d0294a")]
        [TestCase(129, 32, "iris-key", "364c2955933bc7195bd0503bf7357d04dfefd1dbf28942a3531c42113f11543f")]
        [TestCase(32, 16, "iris-key", "8a79a5fa5ce6584df7fa356e15c5902c")]
        [TestCase(255, 16, "0123456789abcdef", "703f20bd9239f5cca2c38d2f40fc11f4")]
        public void Digests(int length, int size, string person, string digest)
        {
            byte[] data = new byte[length + 1];
            for (int i = 0; i < length; i++) data[i + 1] = (byte)i;
            byte[] computed = Blake2b.Compute(data, 1, length, size, person);
            Assert.AreEqual(digest, Golden.ToHex(computed, 0, computed.Length));
        }

        [Test]
        public void OfText()
        {
            byte[] abc = Encoding.ASCII.GetBytes("abc");
            Assert.AreEqual("ba80a53f981c4d0d", Golden.ToHex(Blake2b.Compute(abc, 0, 3, 64), 0, 8)); // RFC 7693, appendix A
        }
    }
}
