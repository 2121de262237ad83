using System;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class CertificateHashTests
    {
        [Test]
        public void HashIsThatOfTheGateway()
        {
            foreach (TestCertificate one in new[] { TestCertificate.First, TestCertificate.Second })
            {
                byte[] der = one.Load().GetRawCertData();
                CollectionAssert.AreEqual(one.Hash, CertificateHash.Compute(der));
                string key = CertificateHash.ToKey(one.Hash);
                Assert.AreEqual(43, key.Length);
                CollectionAssert.AreEqual(one.Hash, CertificateHash.FromKey(key));
            }
            Assert.IsFalse(CertificateHash.AreEqual(TestCertificate.First.Hash, TestCertificate.Second.Hash));
            Assert.IsFalse(CertificateHash.AreEqual(null, null));
        }

        [TestCase("")]
        [TestCase("AAAA")]
        [TestCase("AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAB")]
        [TestCase("AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA*")]
        public void OtherTextsAreNoKeys(string text)
        {
            Assert.IsNull(CertificateHash.FromKey(text));
        }

        [Test]
        public void DamagedCertificatesHaveNoHashOrAnother()
        {
            byte[] good = TestCertificate.First.Load().GetRawCertData();
            for (int length = 0; length < good.Length; length++)
            {
                byte[] cut = new byte[length];
                Array.Copy(good, cut, length);
                Assert.IsNull(CertificateHash.Compute(cut), length.ToString());
            }
            Random random = new Random(3);
            for (int i = 0; i < 20_000; i++)
            {
                byte[] bytes = (byte[])good.Clone();
                for (int k = random.Next(1, 5); k > 0; k--) bytes[random.Next(40)] = (byte)random.Next(256);
                CertificateHash.Compute(bytes);
            }
        }

        [TestCase("https://192.168.0.10:7735/#c=ABC", "https://192.168.0.10:7735")]
        [TestCase("HTTPS://lab.local", "https://lab.local:443")]
        [TestCase("https://[fe80::1]:7725/x", "https://[fe80::1]:7725")]
        [TestCase("https://[fe80::1]", "https://[fe80::1]:443")]
        [TestCase("http://localhost:7725", "http://localhost:7725")]
        [TestCase("http://192.168.0.10:7725", null)]
        [TestCase("https://", null)]
        [TestCase("https://a b:1", null)]
        [TestCase("https://me@host:1", null)]
        [TestCase("https://host:0", null)]
        [TestCase("https://host:99999", null)]
        [TestCase("https://[::1", null)]
        [TestCase("iris://host:1", null)]
        public void AddressesAreParsed(string text, string expected)
        {
            Assert.AreEqual(expected, WebEndpoint.Parse(text)?.ToString());
        }
    }
}
