// A session with one robot over real sockets of this machine, which lets in, refuses and ends as a test says.
using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.IO;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Transport.Tests;
using NUnit.Framework;

namespace IrisSession.Unity.StandinTests
{
    /// <summary>Serves until it is disposed of.</summary>
    internal sealed class GatewaySession : IDisposable
    {
        public const string Code = "7KQ2-M4XD-9PTR";

        /// <summary>Return the refusal of a hello or pairing, null: none.</summary>
        public volatile Func<ClientMessage, ServerMessage> Refuse = message => null;

        /// <summary>Sent behind the snapshot; null: nothing.</summary>
        public volatile ServerMessage Last;

        /// <summary>The WebSocket is closed with it instead of an answer to the hello; 0: it is not.</summary>
        public volatile int CloseCode;

        /// <summary>Whether an e-stop stops robots.</summary>
        public volatile bool Stops = true;

        /// <summary>Everything that came.</summary>
        public readonly ConcurrentQueue<ClientMessage> Received = new ConcurrentQueue<ClientMessage>();
        private readonly FakeGateway gateway;
        private readonly TestCertificate certificate;
        private readonly string scene;
        private readonly string sceneHash = "";

        /// <param name="certificate">For TLS, null for none.</param>
        /// <param name="scene">A folder of `tools/csharp/unity_scenes.py`, null: there is no scene.</param>
        public GatewaySession(TestCertificate certificate = null, string scene = null)
        {
            this.certificate = certificate;
            if (scene != null)
            {
                string vectors = System.Environment.GetEnvironmentVariable("IRIS_VECTORS");
                if (vectors == null) Assert.Ignore("the scenes are written by python -m tools.csharp test");
                this.scene = Path.Combine(vectors, "unity", scene);
                byte[] spec = File.ReadAllBytes(Path.Combine(this.scene, "scene"));
                using (System.Security.Cryptography.SHA256 sha = System.Security.Cryptography.SHA256.Create()) sceneHash = BitConverter.ToString(sha.ComputeHash(spec)).Replace("-", "").ToLowerInvariant();
            }
            gateway = new FakeGateway(Serve, certificate);
        }

        public string Address { get { return gateway.MakeEndpoint().ToString(); } }

        public int Port { get { return gateway.Port; } }

        public bool IsSecure { get { return certificate != null; } }

        public void Dispose() { gateway.Dispose(); }

        /// <summary>Return how many messages of a kind came.</summary>
        public int Count<T>() where T : ClientMessage
        {
            int count = 0;
            foreach (ClientMessage one in Received) if (one is T) count++;
            return count;
        }

        private void Serve(Peer peer)
        {
            string[] request = peer.ReadRequest();
            while (request[0].StartsWith("GET /v1/asset/", StringComparison.Ordinal))
            {
                SendAsset(peer, request);
                request = peer.ReadRequest();
            }
            peer.AcceptWebSocket(int.MaxValue, request);
            WireReader reader = new WireReader();
            while (true)
            {
                KeyValuePair<int, byte[]> frame = peer.ReadFrame();
                if (frame.Key == 0x88) return;
                if (frame.Key != 0x82 || frame.Value[0] != WebMessage.Control) continue;
                reader.Reset(frame.Value, WebMessage.HeadBytes, frame.Value.Length - WebMessage.HeadBytes);
                ClientMessage message = ClientEnvelope.Read(reader).Message;
                Received.Enqueue(message);
                if (message is Hello && CloseCode != 0)
                {
                    peer.Send(Peer.MakeFrame(0x88, new[] { (byte)(CloseCode >> 8), (byte)CloseCode }));
                    return;
                }
                Answer(peer, message);
            }
        }

        private void Answer(Peer peer, ClientMessage message)
        {
            ServerMessage refusal = message is Hello || message is Pair ? Refuse(message) : null;
            if (refusal != null) Send(peer, refusal);
            else if (message is Pair pair)
            {
                byte[] stretched = JoinCode.Stretch(Code, certificate.Hash);
                Send(peer, new Paired { Proof = JoinCode.MakeServerProof(stretched, certificate.Hash, pair.Identity), Roles = new[] { Role.Operator } });
            }
            else if (message is Hello)
            {
                Send(peer, new Welcome { SessionId = "s1", ParticipantId = "p1", ConnectionEpoch = 1, Role = Role.Operator, ResumeToken = new byte[] { 1 }, HeartbeatNs = 1_000_000_000 });
                peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Gateway, WebMessage.EncodeTicket("T1"))));
            }
            else if (message is ClockPing ping) Send(peer, new ClockPong { T0Ns = ping.T0Ns, T1Ns = ping.T0Ns, T2Ns = ping.T0Ns });
            else if (message is GetSnapshot)
            {
                Snapshot snapshot = new Snapshot { EventSeq = 10, SceneEpoch = 3, SceneHash = sceneHash, Bodies = new[] { new BodyInfo { Id = 1, Name = "a" } } };
                snapshot.Participants = new[] { new ParticipantInfo { Id = "p1", Name = "ann", Connected = true } };
                Send(peer, snapshot, new byte[56]);
                if (Last != null) Send(peer, Last);
            }
            else if (message is EStop && Stops) Send(peer, new Event { EventSeq = 11, Body = new EStopChanged { Active = true } });
        }

        private void SendAsset(Peer peer, string[] request)
        {
            string address = request[0].Split(' ')[1].Substring("/v1/asset/".Length);
            string range = Array.Find(request, line => line.StartsWith("Range: bytes=", StringComparison.Ordinal)).Substring(13);
            byte[] asset = File.ReadAllBytes(address == sceneHash ? Path.Combine(scene, "scene") : Path.Combine(scene, "assets", address));
            int first = int.Parse(range.Split('-')[0]);
            int last = Math.Min(asset.Length - 1, int.Parse(range.Split('-')[1]));
            byte[] part = new byte[last - first + 1];
            Array.Copy(asset, first, part, 0, part.Length);
            peer.SendText("HTTP/1.1 206 Partial Content\r\nContent-Length: " + part.Length + "\r\nContent-Range: bytes " + first + "-" + last + "/" + asset.Length + "\r\n\r\n");
            peer.Send(part);
        }

        private static void Send(Peer peer, ServerMessage message, params byte[][] bulk)
        {
            List<byte[]> frames = new List<byte[]> { new ServerEnvelope { Version = Wire.Version, ConnectionEpoch = 1, Message = message }.Encode() };
            frames.AddRange(bulk);
            peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Control, frames.ToArray())));
        }
    }
}
