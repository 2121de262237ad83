// Pairing over real sockets, the identity on files, and beacons.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class PairingTests
    {
        private const string Code = "7KQ2-M4XD-9PTR";
        private static readonly byte[] KeyHash = new byte[32];

        private static PairingResult Pair(Func<Pair, ServerMessage> answer, TestCertificate certificate, TestCertificate pinned = null, string code = Code)
        {
            void Serve(Peer peer)
            {
                peer.AcceptWebSocket();
                byte[] frame = peer.ReadFrame().Value;
                WireReader reader = new WireReader();
                reader.Reset(frame, 6, frame.Length - 6);
                Pair asked = (Pair)ClientEnvelope.Read(reader).Message;
                byte[] envelope = new ServerEnvelope { Version = 1, Message = answer(asked) }.Encode();
                peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Control, envelope)));
                peer.ReadToEnd();
            }

            using (FakeGateway gateway = new FakeGateway(Serve, certificate))
            {
                PairingClient client = new PairingClient(gateway.MakeEndpoint(pinned), code, KeyHash, "ann", "test");
                client.Start();
                Stopwatch watch = Stopwatch.StartNew();
                while (client.Result == null)
                {
                    Assert.Less(watch.ElapsedMilliseconds, Patience.Ms, "no result");
                    Thread.Sleep(1);
                }
                Assert.IsTrue(client.Stop());
                return client.Result;
            }
        }

        private static byte[] ServerProof(string code, byte[] s)
        {
            return JoinCode.MakeServerProof(JoinCode.Stretch(code, s), s, KeyHash);
        }

        [Test]
        public void ACodeThatFitsGivesThePin()
        {
            byte[] s = TestCertificate.First.Hash;
            byte[] proof = null;
            PairingResult result = Pair(
                asked =>
                {
                    proof = asked.Proof;
                    return new Paired { Proof = ServerProof(Code, s), Roles = new[] { Role.Operator } };
                },
                TestCertificate.First);
            Assert.AreEqual(PairingOutcome.Paired, result.Outcome);
            CollectionAssert.AreEqual(s, result.Endpoint.Pin);
            CollectionAssert.AreEqual(new[] { Role.Operator }, result.Roles);
            CollectionAssert.AreEqual(JoinCode.MakeClientProof(JoinCode.Stretch(Code, s), s, KeyHash), proof);
        }

        [Test]
        public void OneWhoDoesNotKnowTheCodeIsNotTrusted()
        {
            // A machine in between shows a certificate of its own and passes on what the session says.
            byte[] relayed = ServerProof(Code, TestCertificate.First.Hash);
            Assert.AreEqual(PairingOutcome.NotProved, Pair(asked => new Paired { Proof = relayed }, TestCertificate.Second).Outcome);
        }

        [Test]
        public void ARefusalIsSaid()
        {
            PairingResult result = Pair(asked => new Refused { Code = RefusalCode.Code }, TestCertificate.First);
            Assert.AreEqual(PairingOutcome.Refused, result.Outcome);
            Assert.AreEqual(RefusalCode.Code, result.Refusal.Code);
        }

        [Test]
        public void AnotherKeyThanThePinnedOneIsNotAsked()
        {
            PairingResult result = Pair(asked => throw new InvalidOperationException("it was asked"), TestCertificate.Second, TestCertificate.First);
            Assert.AreEqual(PairingOutcome.NotReached, result.Outcome);
            Assert.AreEqual(LinkFailure.WrongCertificate, result.End.Failure);
        }

        [Test]
        public void WhatIsNoCodeIsNotSent()
        {
            Assert.AreEqual(PairingOutcome.NoCode, Pair(asked => throw new InvalidOperationException("it was asked"), TestCertificate.First, null, "hello").Outcome);
        }

        [Test]
        public void IdentityLastsAndIsPrivate()
        {
            string folder = Path.Combine(Path.GetTempPath(), "iris-test-" + Guid.NewGuid().ToString("N"));
            try
            {
                FileIdentityStore first = new FileIdentityStore(folder);
                first.Remember(new byte[] { 1, 2, 3 });
                for (int i = 0; i < 70; i++) first.KeepPin("host" + i + ":1", TestCertificate.First.Hash);
                first.KeepPin("host69:1", TestCertificate.Second.Hash);
                FileIdentityStore second = new FileIdentityStore(folder);
                Assert.AreEqual(32, first.Secret.Length);
                CollectionAssert.AreEqual(first.Secret, second.Secret);
                CollectionAssert.AreEqual(new byte[] { 1, 2, 3 }, second.ResumeToken);
                CollectionAssert.AreEqual(TestCertificate.Second.Hash, second.FindPin("host69:1"));
                Assert.IsNull(second.FindPin("host0:1"));
                WebEndpoint cable = new WebEndpoint(false, "localhost", 7725);
                Assert.AreSame(cable, second.WithKnownPin(cable));
                second.KeepPin(cable.Authority, TestCertificate.First.Hash);
                Assert.IsTrue(second.WithKnownPin(cable).IsSecure);
                CollectionAssert.AreEqual(TestCertificate.First.Hash, second.WithKnownPin(cable).Pin);
                Assert.IsNotNull(second.FindPin("host10:1"));
                Assert.AreEqual("", first.Problem + second.Problem);
                CollectionAssert.AreNotEqual(first.Secret, new FileIdentityStore(folder + "/other").Secret);
                using (new FileStream(Path.Combine(folder, "secret"), FileMode.Open, FileAccess.ReadWrite, FileShare.None))
                {
                    FileIdentityStore locked = new FileIdentityStore(folder);
                    Assert.AreEqual(32, locked.Secret.Length);
                    Assert.AreNotEqual("", locked.Problem);
                }
                CollectionAssert.AreEqual(first.Secret, new FileIdentityStore(folder).Secret, "one that cannot be read for a moment stays");
                File.WriteAllBytes(Path.Combine(folder, "secret"), new byte[5]); // damaged: another one is made
                Assert.AreEqual(32, new FileIdentityStore(folder).Secret.Length);
            }
            finally
            {
                Directory.Delete(folder, true);
            }
        }

        [Test]
        public void AFolderThatCannotBeWrittenIsSaidAndTheAppGoesOn()
        {
            string file = Path.GetTempFileName();
            FileIdentityStore store = new FileIdentityStore(Path.Combine(file, "below"));
            store.Remember(new byte[] { 1 });
            Assert.AreEqual(32, store.Secret.Length);
            CollectionAssert.AreEqual(new byte[] { 1 }, store.ResumeToken);
            Assert.AreNotEqual("", store.Problem);
            File.Delete(file);
        }

        [Test]
        public void BeaconsAreHeard()
        {
            int port;
            using (Socket free = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
            {
                free.Bind(new IPEndPoint(IPAddress.Loopback, 0));
                port = ((IPEndPoint)free.LocalEndPoint).Port;
            }
            BeaconListener listener = new BeaconListener(port);
            listener.Start();
            byte[] beacon = new Beacon { Protocol = 1, SessionId = "s1", SessionName = "lab", Kind = "teleop", Host = "127.0.0.1", Control = 7721, Web = 7725 }.Encode();
            List<FoundSession> found = listener.ListSessions();
            using (Socket sender = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
            {
                Stopwatch watch = Stopwatch.StartNew();
                while (found.Count == 0) // until it listens
                {
                    Assert.Less(watch.ElapsedMilliseconds, Patience.Ms, listener.Problem);
                    sender.SendTo(new byte[3000], new IPEndPoint(IPAddress.Loopback, port));
                    sender.SendTo(beacon, new IPEndPoint(IPAddress.Loopback, port));
                    Thread.Sleep(1);
                    found = listener.ListSessions();
                }
            }
            Assert.AreEqual("lab", found[0].Beacon.SessionName);
            Assert.IsTrue(listener.Stop());
        }
    }
}
