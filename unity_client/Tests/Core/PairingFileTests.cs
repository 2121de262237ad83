using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class PairingFileTests
    {
        // As tests/cli/test_keys.py has it, with a key that the app does not know.
        private const string Good = "{\n  \"format\": 1,\n  \"session\": \"lab-\\u0031\",\n  \"addresses\": [\n    \"https://10.0.0.5:8443/\",\n    \"https://[fd00::5]:8443/\"\n  ],\n"
            + "  \"pin\": \"__79_Pv6-fj39vX08_Lx8O_u7ezr6uno5-bl5OPi4eA\",\n  \"code\": \"7KQ2-M4XD-9PTR\",\n  \"expires\": 1790000000.25,\n  \"later\": {\"a\": [1, [true], null]}\n}\n";

        [Test]
        public void FileOfTheCommandIsRead()
        {
            PairingFile file = PairingFile.Parse(Good);
            Assert.AreEqual("lab-1", file.Session);
            CollectionAssert.AreEqual(new[] { "https://10.0.0.5:8443/", "https://[fd00::5]:8443/" }, file.Addresses);
            Assert.AreEqual(32, file.Pin.Length);
            Assert.AreEqual(0xff, file.Pin[0]);
            Assert.AreEqual(0xe0, file.Pin[31]);
            Assert.AreEqual("7KQ2-M4XD-9PTR", file.Code);
            Assert.IsFalse(file.HasExpired(1790000000));
            Assert.IsTrue(file.HasExpired(1790000001));
        }

        [TestCase("\"format\": 1", "\"format\": 2")]
        [TestCase("\"format\": 1", "\"format\": \"1\"")]
        [TestCase("\"format\": 1", "\"format\": 1e999")]
        [TestCase("\"code\"", "\"kode\"")]
        [TestCase("__79", "__7")]
        [TestCase("__79", "!!79")]
        [TestCase("\"https://10.0.0.5:8443/\"", "5")]
        [TestCase("}\n", "}}")]
        [TestCase("\\u0031", "\\u00zz")]
        [TestCase("[true]", "[[[[[[[[[[]]]]]]]]]]")]
        public void FileThatIsNotRightIsRefusedInWords(string from, string to)
        {
            Assert.Throws<PairingFileException>(() => PairingFile.Parse(Good.Replace(from, to)));
        }

        [Test]
        public void AnyDamageIsRefusedInWords()
        {
            Random random = new Random(9);
            for (int length = 0; length < Good.Length - 2; length++) Assert.Throws<PairingFileException>(() => PairingFile.Parse(Good.Substring(0, length)));
            Assert.Throws<PairingFileException>(() => PairingFile.Parse(new string('[', 60_000)));
            Assert.Throws<PairingFileException>(() => PairingFile.Parse(new string(' ', 70_000)));
            for (int i = 0; i < 5_000; i++)
            {
                char[] damaged = Good.ToCharArray();
                damaged[random.Next(damaged.Length)] = (char)random.Next(1, 300);
                try
                {
                    PairingFile.Parse(new string(damaged));
                }
                catch (PairingFileException)
                {
                }
            }
        }
    }
}
