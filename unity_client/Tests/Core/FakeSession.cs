// The other side of a connection: makes the messages of a session, and reads what the client sends.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core.Tests
{
    internal sealed class FakeSession
    {
        public const long Ms = 1_000_000;
        public const long Second = 1_000_000_000;
        private const long ClockOffset = 5 * Second;

        public readonly MemoryIdentity Identity = new MemoryIdentity(new byte[32], new byte[0]);
        public readonly ClientConnection Client;
        public readonly List<ClientMessage> Sent = new List<ClientMessage>();
        public long NowNs;
        public long EventSeq = 10;
        public long StateSeq = 100;
        private long epoch;

        public FakeSession()
        {
            Client = new ClientConnection(new Hello { Role = Role.Operator, Name = "ann", Devices = new[] { Device.ControllerRight } }, Identity);
        }

        /// <summary>Let the client join until it is ready.</summary>
        public static FakeSession Join()
        {
            FakeSession session = new FakeSession();
            session.Client.Open(0);
            session.AnswerHello();
            return session;
        }

        /// <summary>Welcome the client, and answer its requests until it is ready.</summary>
        public void AnswerHello()
        {
            Advance(0);
            Receive(new Welcome
            {
                SessionId = "s1",
                ParticipantId = "p1",
                ConnectionEpoch = ++epoch,
                Role = Role.Operator,
                ResumeToken = new[] { (byte)epoch },
                HeartbeatNs = Second,
                Endpoints = new Endpoints(),
            });
            for (int i = 0; i < 20; i++) Advance(5 * Ms);
        }

        /// <summary>Let time pass in one step: the client ticks, and what it asks is answered.</summary>
        public void Advance(long ns)
        {
            NowNs += ns;
            Client.Tick(NowNs);
            foreach (ClientMessage message in TakeSent())
            {
                Sent.Add(message);
                if (message is ClockPing ping) Receive(new ClockPong { T0Ns = ping.T0Ns, T1Ns = ping.T0Ns + ClockOffset, T2Ns = ping.T0Ns + ClockOffset });
                else if (message is GetSnapshot) SendSnapshot();
            }
        }

        /// <summary>Return the messages that wait to be sent, and remove them.</summary>
        public List<ClientMessage> TakeSent()
        {
            List<ClientMessage> sent = new List<ClientMessage>();
            for (Outgoing item = Client.PeekOutgoing(); item != null; item = Client.PeekOutgoing())
            {
                WireReader reader = new WireReader();
                reader.Reset(item.Bytes, 0, item.Count);
                sent.Add(ClientEnvelope.Read(reader).Message);
                Client.PopOutgoing(true);
            }
            return sent;
        }

        public void Receive(ServerMessage message, byte[] bulk = null)
        {
            Client.Receive(MakeMessage(new ServerEnvelope { Version = 1, ConnectionEpoch = epoch, Message = message }.Encode(), bulk), NowNs);
        }

        public void SendEvent(EventKind body)
        {
            Receive(new Event { EventSeq = ++EventSeq, Body = body });
        }

        public void SendSnapshot()
        {
            Receive(
                new Snapshot
                {
                    EventSeq = EventSeq,
                    SceneEpoch = 3,
                    StateSeq = StateSeq,
                    Participants = new[] { new ParticipantInfo { Id = "p1", Name = "ann", Connected = true }, new ParticipantInfo { Id = "p2", Name = "bob", Connected = true } },
                    Leases = new[] { new Lease { Target = "left", Kind = "robot", Holder = "p1", LeaseVersion = 7 }, new Lease { Target = "right", Kind = "robot", Holder = "p2", LeaseVersion = 4 } },
                    Robots = new[] { new RobotInfo { Name = "left" }, new RobotInfo { Name = "right" } },
                    Bodies = new[] { new BodyInfo { Id = 1, Name = "a" }, new BodyInfo { Id = 4, Name = "cube", Object = true } },
                },
                new byte[2 * 56]);
        }

        public static Multipart MakeMessage(params byte[][] frames)
        {
            int total = 0;
            foreach (byte[] frame in frames) total += frame == null ? 0 : frame.Length;
            Multipart message = new Multipart { Buffer = new byte[total] };
            int at = 0;
            foreach (byte[] frame in frames)
            {
                if (frame == null) continue;
                frame.CopyTo(message.Buffer, at);
                message.Add(at, frame.Length);
                at += frame.Length;
            }
            return message;
        }
    }
}
