// A session without sockets: the loop's clock, its transport, and the answers of a session, all under the test's control.
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport.Tests
{
    /// <summary>Sockets that a test opens, closes and fills.</summary>
    internal sealed class FakeTransport : ITransport
    {
        public readonly List<WebEndpoint> Opened = new List<WebEndpoint>();
        public readonly List<ClientEnvelope> Sent = new List<ClientEnvelope>();
        public readonly List<WebEndpoint> Probes = new List<WebEndpoint>();
        public readonly Queue<Multipart> Control = new Queue<Multipart>();
        public readonly Queue<Multipart> States = new Queue<Multipart>();
        public readonly Queue<ProbeAnswer> ProbeAnswers = new Queue<ProbeAnswer>();
        public List<string> Wishes = new List<string>();
        public long MediaEpoch;
        public bool IsFull;
        public int Wakes;
        public bool IsDisposed;

        /// <summary>Called within every send: a test may block there.</summary>
        public Action OnSend = () => { };
        private readonly AutoResetEvent news = new AutoResetEvent(false);

        public TransportState State { get; set; }

        public LinkEnd End { get; set; }

        public string Ticket { get; set; } = "";

        public TransportCounters Counters { get; } = new TransportCounters();

        public WebEndpoint Newest { get { return Opened[Opened.Count - 1]; } }

        public void Open(WebEndpoint endpoint)
        {
            Opened.Add(endpoint);
            State = TransportState.Open;
            End = default;
            Control.Clear();
            States.Clear();
        }

        public void Close()
        {
            State = TransportState.Closed;
            End = default;
        }

        /// <summary>The other end closes, or does not answer.</summary>
        public void Break(LinkFailure failure, int code = 0, byte[] certificateHash = null)
        {
            State = TransportState.Closed;
            End = new LinkEnd(failure, code, "", certificateHash);
        }

        public bool TrySend(byte[] bytes, int count)
        {
            OnSend();
            if (State != TransportState.Open || IsFull) return false;
            WireReader reader = new WireReader();
            reader.Reset(bytes, 0, count);
            lock (Sent) Sent.Add(ClientEnvelope.Read(reader));
            return true;
        }

        public bool TryTakeControl(ref Multipart message)
        {
            return TryTake(Control, ref message);
        }

        public bool TryTakeState(ref Multipart message)
        {
            return TryTake(States, ref message);
        }

        public bool TryTakeMedia(ref Multipart message)
        {
            return false;
        }

        public string TakeNotice()
        {
            return null;
        }

        public void SetMedia(IReadOnlyList<string> streams, long connectionEpoch)
        {
            Wishes = new List<string>(streams);
            MediaEpoch = connectionEpoch;
        }

        public IAssetChannel OpenAssets()
        {
            return null;
        }

        public void StartProbe(WebEndpoint endpoint)
        {
            Probes.Add(endpoint);
        }

        public bool TryTakeProbe(out ProbeAnswer answer)
        {
            answer = ProbeAnswers.Count > 0 ? ProbeAnswers.Peek() : default;
            if (ProbeAnswers.Count == 0) return false;
            ProbeAnswers.Dequeue();
            return true;
        }

        public long Tick(long nowNs)
        {
            return long.MaxValue;
        }

        public void Wait(int milliseconds)
        {
            news.WaitOne(milliseconds);
        }

        public void Wake()
        {
            Interlocked.Increment(ref Wakes);
            news.Set();
        }

        public void Dispose()
        {
            IsDisposed = true;
        }

        private static bool TryTake(Queue<Multipart> queue, ref Multipart message)
        {
            lock (queue)
            {
                if (queue.Count == 0) return false;
                message = queue.Dequeue();
                return true;
            }
        }
    }

    internal sealed class MemoryIdentity : IIdentityStore
    {
        public byte[] Secret { get; } = new byte[32];

        public byte[] ResumeToken { get; private set; } = new byte[0];

        public void Remember(byte[] token)
        {
            ResumeToken = (byte[])token.Clone();
        }
    }

    /// <summary>A loop with a clock of its own, and the session that answers it.</summary>
    internal sealed class LoopRig : ISessionListener
    {
        public const long Ms = 1_000_000;
        public const long Second = 1_000_000_000;
        private const long ClockOffset = 5 * Second;

        public readonly FakeTransport Transport = new FakeTransport();
        public readonly EndpointChooser Endpoints;
        public readonly MemoryIdentity Identity = new MemoryIdentity();
        public readonly SessionLoop Loop;
        public readonly List<ClientMessage> Received = new List<ClientMessage>();
        public long NowNs = Second;
        public int States;
        public int PresenceUpdates;
        private int taken;
        private long epoch;
        private long stateSeq = 100;

        public LoopRig(params WebEndpoint[] endpoints)
        {
            Endpoints = new EndpointChooser(endpoints);
            Hello hello = new Hello { Role = Role.Operator, Name = "ann", Devices = new[] { Device.ControllerRight } };
            Loop = new SessionLoop(new ClientConnection(hello, Identity), Transport, Endpoints, this, () => NowNs);
        }

        public ConnectionPhase Phase { get { return Loop.Connection.Phase; } }

        /// <summary>Let time pass, and answer what the client asks, unless nothing answers.</summary>
        public void Run(long ns, bool answers = true)
        {
            long until = NowNs + ns;
            while (true)
            {
                Loop.Step();
                if (answers) Answer();
                else taken = Transport.Sent.Count;
                Loop.Step();
                if (NowNs >= until) return;
                NowNs = Math.Min(until, NowNs + Math.Max(Ms, Math.Min(Loop.NextWaitNs(), 5 * Ms)));
            }
        }

        public void Join()
        {
            Loop.Open();
            Run(200 * Ms);
            NUnit.Framework.Assert.AreEqual(ConnectionPhase.Ready, Phase);
        }

        public void SendState(long session_ns = 0)
        {
            StateHeader header = new StateHeader
            {
                SceneEpoch = 3, StateSeq = ++stateSeq, BaseSeq = stateSeq - 1, SessionTime = NowNs + ClockOffset + session_ns, PublishedNs = NowNs + ClockOffset + session_ns,
            };
            Transport.States.Enqueue(MakeMessage(System.Text.Encoding.ASCII.GetBytes("rigid"), header.Encode(), EmptyPayload(2)));
        }

        public void Send(ServerMessage message, byte[] bulk = null)
        {
            byte[] bytes = new ServerEnvelope { Version = 1, ConnectionEpoch = epoch, Message = message }.Encode();
            Transport.Control.Enqueue(bulk == null ? MakeMessage(bytes) : MakeMessage(bytes, bulk));
        }

        public static Multipart MakeMessage(params byte[][] frames)
        {
            Multipart message = new Multipart { Buffer = Peer.Join(frames) };
            int at = 0;
            foreach (byte[] frame in frames)
            {
                message.Add(at, frame.Length);
                at += frame.Length;
            }
            return message;
        }

        /// <summary>Return a payload without bodies, of a scene of so many: all rest.</summary>
        public static byte[] EmptyPayload(int bodies)
        {
            byte[] payload = new byte[20 + (bodies + 7) / 8];
            payload[0] = 2;
            payload[2] = (byte)bodies;
            return payload;
        }

        void ISessionListener.OnState(SessionLoop loop)
        {
            States++;
        }

        void ISessionListener.OnPresence(SessionLoop loop)
        {
            PresenceUpdates++;
        }

        void ISessionListener.OnMedia(SessionLoop loop, ref Multipart message)
        {
        }

        void ISessionListener.OnNotice(SessionLoop loop, string text)
        {
        }

        private void Answer()
        {
            for (; taken < Transport.Sent.Count; taken++)
            {
                ClientMessage message = Transport.Sent[taken].Message;
                Received.Add(message);
                if (message is Hello) Welcome();
                else if (message is ClockPing ping) Send(new ClockPong { T0Ns = ping.T0Ns, T1Ns = ping.T0Ns + ClockOffset, T2Ns = ping.T0Ns + ClockOffset });
                else if (message is GetSnapshot) Snapshot();
            }
        }

        private void Welcome()
        {
            epoch++;
            Send(new Welcome
            {
                SessionId = "s1", ParticipantId = "p1", ConnectionEpoch = epoch, Role = Role.Operator, ResumeToken = new[] { (byte)epoch }, HeartbeatNs = Second,
                Endpoints = new Endpoints(),
            });
        }

        private void Snapshot()
        {
            Send(
                new Snapshot
                {
                    EventSeq = 10, SceneEpoch = 3, StateSeq = stateSeq,
                    Participants = new[] { new ParticipantInfo { Id = "p1", Name = "ann", Connected = true } },
                    Leases = new[] { new Lease { Target = "left", Kind = "robot", Holder = "p1", LeaseVersion = 7 } },
                    Robots = new[] { new RobotInfo { Name = "left" } },
                    Bodies = new[] { new BodyInfo { Id = 1, Name = "a" }, new BodyInfo { Id = 4, Name = "cube", Object = true } },
                },
                new byte[2 * 56]);
        }
    }
}
