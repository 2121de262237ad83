// Bytes and texts of strangers, for decoders that have no test of their own for them: no foreign exception, and no memory for what
// the bytes only claim.
using System;
using System.Collections.Generic;
using System.Linq;
using System.Text;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class HostileInputTests
    {
        // Of an exception with its stack trace, and for each byte of the input; a field of a message may be an object of its own.
        private const long AllocatedAtMost = 60_000;
        private const long AllocatedPerByte = 600;

        private static int Rounds { get { return int.Parse(System.Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "2000"); } }

        [Test]
        public void Clouds()
        {
            Cloud cloud = new Cloud();
            Fuzz(Golden.Load("cloud")["frames"].Items.Select(row => Golden.FromHex(row["hex"].Text)), data => cloud.Decode(data, 0, data.Length));
        }

        [Test]
        public void Topologies()
        {
            IEnumerable<byte[]> seeds = Golden.Load("deformable")["meshes"].Items.Select(row => Golden.FromHex(row["topology"].Text)).Where(seed => seed.Length < 3_000);
            Fuzz(seeds, data => Assert.Greater(new DeformableTopology(data, 0, data.Length).VertexCount, 0));
        }

        [Test]
        public void BeaconsAndIntroductions()
        {
            BeaconTable table = new BeaconTable();
            byte[] beacon = new Beacon { Protocol = Wire.Version, SessionId = "id", SessionName = "lab", Kind = "live", Host = "10.0.0.5", Control = 7721 }.Encode();
            long sum = 0;
            Fuzz(new[] { beacon }, data =>
            {
                FoundSession found = table.Process(data, 0, data.Length, "10.0.0.9", 0);
                if (found != null) sum += found.Beacon.Control;
            });
            byte[] body = new Introduction { Beacon = Beacon.Read(new WireReader(beacon)), ServerKey = new string('k', 40) }.Encode();
            byte[] introduction = new[] { (byte)0, (byte)0, (byte)(body.Length >> 8), (byte)body.Length }.Concat(body).ToArray();
            Fuzz(new[] { introduction }, data => BeaconTable.DecodeIntroduction(data, data.Length, 7721));
            Assert.Greater(table.Malformed, sum > 0 ? 0 : long.MaxValue);
        }

        [Test]
        public void State()
        {
            StateStream stream = new StateStream { SceneEpoch = 1 };
            stream.LoadKeyframe(0, 20, new byte[56 * 20], 0, 56 * 20);
            byte[] header = new StateHeader { SceneEpoch = 1, StateSeq = 5, Applied = new[] { new Applied { Robot = "left" } } }.Encode();
            byte[] presence = new Presence { Items = new[] { new PresenceItem { Participant = "p", Device = "head" } } }.Encode();
            byte[] rigid = Encoding.ASCII.GetBytes("rigid");
            byte[] payload = RigidDecoderTests.MakeFrame(20);
            byte[] topic = Encoding.ASCII.GetBytes("presence");
            long now = 0;
            Fuzz(new[] { header }, data => stream.Drain(new[] { FakeSession.MakeMessage(rigid, data, payload) }, ++now, now));
            Fuzz(new[] { payload }, data => stream.Drain(new[] { FakeSession.MakeMessage(rigid, header, data) }, ++now, now));
            Fuzz(new[] { presence }, data =>
            {
                stream.Drain(new[] { FakeSession.MakeMessage(topic, data) }, ++now, now);
                Assert.LessOrEqual(stream.Presence.ListItems().Count, 1024);
            });
            Assert.Greater(stream.Counters.Malformed, 0);
        }

        [Test]
        public void Meshes()
        {
            ArrayDecoder decoder = new ArrayDecoder();
            byte[][] seeds = Golden.Load("arrays")["assets"].Items.Select(row => Golden.FromHex(row["hex"].Text)).Where(seed => IsMesh(decoder.Decode(seed))).ToArray();
            Assert.Greater(seeds.Length, 1);
            // A stream may hold a thousand times its length: of that a MiB is decoded.
            Fuzz(seeds, data => MeshArrays.FromAsset(decoder.Decode(data, 1 << 20)), 5_000_000);
            HeightField field = new HeightField { Rows = 3, Columns = 4, Size = new[] { 1.0, 1.0, 1.0, 1.0 } };
            Random random = new Random(34);
            for (int i = 0; i < 200; i++)
            {
                field.Rows = random.Next(2) == 0 ? 3 : random.Next(-1, 5) * (1L << random.Next(62));
                field.Columns = random.Next(2) == 0 ? 4 : random.Next(-1, 5) * (1L << random.Next(62));
                bool isRight = field.Rows == 3 && field.Columns == 4;
                if (isRight) Assert.Greater(MeshArrays.FromHeightField(field, new float[12]).VertexCount, 0);
                else if (field.Rows * (double)field.Columns != 12) Assert.Throws<DecodeException>(() => MeshArrays.FromHeightField(field, new float[12]));
            }
        }

        private static bool IsMesh(ArrayAsset asset) { return asset.Kind == ArrayKind.Mesh && asset.Find("position") != null && asset.Find("normal") != null && asset.Find("index") != null; }

        [Test]
        public void Texts()
        {
            Random random = new Random(34);
            string[] seeds = { "iris://10.0.0.5:7721/?k=" + new string('A', 43) + "&c=7KQ2-M4XD-9PTR&n=lab", "https://[fe80::1%eth0]:7725/#c=7kq2m4xd9ptr", "192.168.0.10:7721", "\ud83e\udd16%C3%28" };
            for (int i = 0; i < Rounds; i++)
            {
                StringBuilder text = new StringBuilder(seeds[random.Next(seeds.Length)]);
                for (int n = random.Next(1, 5); n > 0; n--)
                {
                    int at = random.Next(text.Length + 1);
                    if (random.Next(2) == 0) text.Insert(at, random.Next(4) == 0 ? (char)random.Next(0x10000) : (char)random.Next(32, 127));
                    else if (at < text.Length) text.Remove(at, 1);
                }
                Check(text.Length, AllocatedAtMost, () =>
                {
                    try
                    {
                        PairingLink link = PairingLink.Parse(text.ToString());
                        if (!HostName.IsHost(link.Host)) Assert.Fail(text.ToString());
                    }
                    catch (LinkException)
                    {
                    }
                }, () => text.ToString());
            }
        }

        private static void Fuzz(IEnumerable<byte[]> seeds, Action<byte[]> decode, long allocatedAtMost = AllocatedAtMost)
        {
            byte[][] golden = seeds.ToArray();
            Random random = new Random(34);
            foreach (byte[] seed in golden) decode(seed); // buffers grow to what is right
            int refused = 0;
            for (int i = 0; i < Rounds; i++)
            {
                byte[] data = Hostile.Mutate(golden[random.Next(golden.Length)], random);
                Check(data.Length, allocatedAtMost, () =>
                {
                    try
                    {
                        decode(data);
                    }
                    catch (DecodeException)
                    {
                        refused++;
                    }
                }, () => Golden.ToHex(data, 0, data.Length));
            }
            Assert.Less(refused, Rounds, "nothing was read");
        }

        private static void Check(int length, long allocatedAtMost, Action decode, Func<string> describe)
        {
            long before = GC.GetAllocatedBytesForCurrentThread();
            try
            {
                decode();
            }
            catch (AssertionException)
            {
                throw;
            }
            catch (Exception error)
            {
                Assert.Fail("{0} {1}", describe(), error);
            }
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            if (allocated > allocatedAtMost + AllocatedPerByte * length) Assert.Fail("{0} bytes allocated for {1}", allocated, describe());
        }
    }
}
