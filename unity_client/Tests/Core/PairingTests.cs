// Addresses, links, join codes, fingerprints and beacons: as the Python client takes them (tools/csharp/pairing_vectors.py).
using System;
using System.Collections.Generic;
using System.IO;
using System.Text;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class PairingTests
    {
        private const long Second = 1_000_000_000;

        [Test]
        public void HostsAreThoseOfPython()
        {
            foreach (string[] row in Load("host", 40))
            {
                string host = Text(row[1]);
                Assert.AreEqual(row[2] == "1", HostName.IsHost(host), host);
                if (row[2] == "1" && !host.EndsWith("%")) Assert.AreEqual(row[3] == "1", HostName.IsLoopback(host), host);
            }
            Assert.IsTrue(HostName.IsLoopback("::ffff:127.0.0.1"));
            Assert.IsFalse(HostName.IsLoopback("::ffff:10.0.0.1"));
        }

        [Test]
        public void LinksAreThoseOfPython()
        {
            int refused = 0;
            foreach (string[] row in Load("link", 40))
            {
                string text = Text(row[1]);
                PairingLink link = TryParse(text, out LinkFault? fault);
                if (row.Length == 2)
                {
                    refused++;
                    Assert.IsNull(link, text);
                    continue;
                }
                Assert.IsNull(fault, text);
                Assert.AreEqual(row[2], link.Host, text);
                Assert.AreEqual(int.Parse(row[3]), link.ControlPort, text);
                Assert.AreEqual(row[4], link.ServerKey == null ? "" : Golden.ToHex(link.ServerKey, 0, 32), text);
                Assert.AreEqual(row[5], link.Code, text);
                Assert.AreEqual(Text(row[6]), link.SessionName, text);
            }
            Assert.Greater(refused, 40);
        }

        [Test]
        public void PagesHaveHostPortAndCode()
        {
            PairingLink link = PairingLink.Parse(" https://192.168.0.10:7725/#c=7KQ2-M4XD-9PTR ");
            Assert.AreEqual(LinkKind.Page, link.Kind);
            Assert.AreEqual("192.168.0.10:7725", link.ToString());
            Assert.AreEqual(0, link.ControlPort);
            Assert.AreEqual("7KQ2M4XD9PTR", link.Code);
            Assert.IsTrue(link.IsEncrypted);
            Assert.AreEqual("[::1]:7725", PairingLink.Parse("http://[::1]:7725/").ToString());
            Assert.AreEqual(443, PairingLink.Parse("https://lab/?x=1#y").WebPort);
            Assert.AreEqual(7725, PairingLink.Parse("lab").WebPort);
            Assert.IsTrue(PairingLink.Parse("http://localhost:7725").IsLoopback);
        }

        [TestCase("", LinkFault.Empty)]
        [TestCase("ftp://lab", LinkFault.Scheme)]
        [TestCase("WIFI:S:lab;;", LinkFault.Host)]
        [TestCase("https://user@lab/", LinkFault.Host)]
        [TestCase("https:///#c=7KQ2-M4XD-9PTR", LinkFault.Host)]
        [TestCase("lab:0", LinkFault.Port)]
        [TestCase("iris://lab/?k=AAAA", LinkFault.Key)]
        [TestCase("https://lab/#c=7KQ2", LinkFault.JoinCode)]
        [TestCase("http://192.168.0.10:7725/", LinkFault.NotEncrypted)]
        public void FaultsAreTyped(string text, LinkFault expected)
        {
            Assert.IsNull(TryParse(text, out LinkFault? fault));
            Assert.AreEqual(expected, fault);
        }

        [Test]
        public void AnyTextIsALinkOrALinkException()
        {
            Assert.AreEqual(LinkFault.Empty, Assert.Throws<LinkException>(() => PairingLink.Parse(null)).Fault);
            Assert.AreEqual(LinkFault.TooLong, Assert.Throws<LinkException>(() => PairingLink.Parse("iris://" + new string('a', 3000))).Fault);
            Random random = new Random(34);
            string pieces = "iris://https:#?&=%c=k=[]::@.+1a\ud83d\0\n\u2028ü-";
            for (int i = 0; i < 3000; i++)
            {
                StringBuilder text = new StringBuilder(random.Next(2) == 0 ? "iris://" : "");
                for (int n = random.Next(30); n > 0; n--) text.Append(pieces[random.Next(pieces.Length)]);
                try
                {
                    PairingLink.Parse(text.ToString());
                }
                catch (LinkException error)
                {
                    Assert.IsFalse(error.Message.IndexOfAny("\n\r\0\u2028".ToCharArray()) >= 0, error.Message);
                    Assert.Less(error.Message.Length, 250);
                }
            }
        }

        [Test]
        public void CodesProofsAndFingerprintsAreThoseOfPython()
        {
            foreach (string[] row in Load("code", 8))
            {
                Assert.AreEqual(row[2].Length == 0 ? null : row[2], JoinCode.Normalise(Text(row[1])), Text(row[1]));
            }
            Assert.AreEqual("7KQ2-M4XD-9PTR", JoinCode.Format("7KQ2M4XD9PTR"));
            foreach (string[] row in Load("key", 4)) Assert.AreEqual(row[2], Fingerprint.OfKey(Golden.FromHex(row[1])));
            foreach (string[] row in Load("certificate", 4)) Assert.AreEqual(row[2], Fingerprint.OfCertificate(Golden.FromHex(row[1])).Replace(":", ""));
            Assert.AreEqual("E3:B0:C4", Fingerprint.OfCertificate(new byte[0]).Substring(0, 8));
            foreach (string[] row in Load("proof", 1))
            {
                byte[] s = Golden.FromHex(row[2]);
                byte[] c = Golden.FromHex(row[3]);
                byte[] stretched = JoinCode.Stretch(Text(row[1]), s);
                Assert.AreEqual(row[4], Golden.ToHex(stretched, 0, 32));
                byte[] client = JoinCode.MakeClientProof(stretched, s, c);
                byte[] server = JoinCode.MakeServerProof(stretched, s, c);
                Assert.AreEqual(row[5], Golden.ToHex(client, 0, 32));
                Assert.AreEqual(row[6], Golden.ToHex(server, 0, 32));
                Assert.IsFalse(JoinCode.IsSameProof(client, server));
                Assert.IsFalse(JoinCode.IsSameProof(server, new byte[0]));
                Assert.IsTrue(JoinCode.IsSameProof(server, (byte[])server.Clone()));
            }
            Assert.AreEqual(LinkFault.JoinCode, Assert.Throws<LinkException>(() => JoinCode.Stretch("7KQ2", new byte[32])).Fault);
        }

        [Test]
        public void BeaconsAreAcceptedAsByPython()
        {
            foreach (string[] row in Load("beacon", 30))
            {
                BeaconTable table = new BeaconTable();
                byte[] data = Golden.FromHex(row[1]);
                FoundSession found = table.Process(data, 0, data.Length, row[2], 0);
                string outcome = found != null ? found.Addresses[0] : table.Malformed == 1 ? "malformed" : table.OtherVersion == 1 ? "other_version" : table.ForeignLoopback == 1 ? "foreign_loopback" : "";
                Assert.AreEqual(row[3], outcome, row[1]);
            }
        }

        [Test]
        public void FoundSessionsAreBounded()
        {
            BeaconTable table = new BeaconTable();
            for (int i = 0; i < 200; i++) Hear(table, "id" + i, "10.0.0." + i, i * Second);
            Assert.AreEqual(128, table.ListSessions().Count);
            Assert.AreEqual(72, table.TooMany);
            for (int i = 0; i < 200; i++) Hear(table, "id7", "10.0.1." + i, 300 * Second);
            table.RemoveSilent(100 * Second);
            Assert.AreEqual(29, table.ListSessions().Count);
            FoundSession known = table.ListSessions().Find(one => one.Beacon.SessionId == "id7");
            Assert.AreEqual(new[] { "10.0.0.7:7721", "10.0.1.0:7721", "10.0.1.1:7721", "10.0.1.2:7721" }, known.Addresses);
            Assert.AreEqual("10.0.0.7", known.Beacon.Host);
            Assert.IsNotNull(Hear(table, "new", "10.0.0.1", 300 * Second));
        }

        [Test]
        public void IntroductionsAreAcceptedAsByPython()
        {
            foreach (string[] row in Load("introduction", 10))
            {
                byte[] data = Golden.FromHex(row[1]);
                string outcome;
                try
                {
                    Introduction introduction = BeaconTable.DecodeIntroduction(data, data.Length, int.Parse(row[2]));
                    outcome = introduction == null ? "more" : introduction.Beacon.SessionId;
                }
                catch (DecodeException)
                {
                    outcome = "refused";
                }
                Assert.AreEqual(row[3], outcome, row[1]);
            }
        }

        private static FoundSession Hear(BeaconTable table, string id, string host, long nowNs)
        {
            byte[] data = new Beacon { Protocol = Wire.Version, SessionId = id, SessionName = "lab", Kind = "live", Host = host, Control = 7721 }.Encode();
            return table.Process(data, 0, data.Length, host, nowNs);
        }

        private static PairingLink TryParse(string text, out LinkFault? fault)
        {
            fault = null;
            try
            {
                return PairingLink.Parse(text);
            }
            catch (LinkException error)
            {
                fault = error.Fault;
                return null;
            }
        }

        private static string Text(string hex) { return Encoding.UTF8.GetString(Golden.FromHex(hex)); }

        private static List<string[]> Load(string kind, int least)
        {
            string folder = System.Environment.GetEnvironmentVariable("IRIS_VECTORS");
            if (folder == null) Assert.Ignore("the vectors are written by python -m tools.csharp test");
            List<string[]> rows = new List<string[]>();
            foreach (string line in File.ReadLines(Path.Combine(folder, "pairing.txt")))
            {
                string[] row = line.Split('\t');
                if (row[0] == kind) rows.Add(row);
            }
            Assert.GreaterOrEqual(rows.Count, least);
            return rows;
        }
    }
}
