// Pairs this app with a session by a join code: one WebSocket, one `pair`, one answer. docs/protocol.md, pairing behind a gateway.
//
// The key of the gateway need not be known: both proofs are over the key that TLS has shown, so that a machine in between cannot
// answer. When the code fits, the key is the pin from then on.
using System;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>What became of a pairing.</summary>
    public enum PairingOutcome
    {
        Paired,

        /// <summary>The session refuses it: `RefusalCode`, such as `code` for one that is wrong, used or expired.</summary>
        Refused,

        /// <summary>The session did not prove that it knows the code: another machine may pretend to be it.</summary>
        NotProved,

        /// <summary>No gateway was reached: `End`.</summary>
        NotReached,

        /// <summary>It did not answer in time, or its answer could not be read. The same may be tried again.</summary>
        NoAnswer,

        /// <summary>The text is no join code.</summary>
        NoCode,

        /// <summary>It was stopped.</summary>
        Stopped,
    }

    /// <summary>Result of a pairing.</summary>
    public sealed class PairingResult
    {
        public readonly PairingOutcome Outcome;

        /// <summary>The endpoint with its pin, once paired.</summary>
        public readonly WebEndpoint Endpoint;

        /// <summary>Roles that this app may join as; empty: any.</summary>
        public readonly string[] Roles;

        /// <summary>Why the session refuses it.</summary>
        public readonly Refused Refusal;
        public readonly LinkEnd End;

        internal PairingResult(PairingOutcome outcome, WebEndpoint endpoint = null, string[] roles = null, Refused refusal = null, LinkEnd end = default)
        {
            Outcome = outcome;
            Endpoint = endpoint;
            Roles = roles ?? new string[0];
            Refusal = refusal;
            End = end;
        }
    }

    /// <summary>One pairing on a thread of its own. Poll <see cref="Result"/>.</summary>
    public sealed class PairingClient : ILinkListener
    {
        /// <summary>Time for the connection and the answer, and the pause after `rate`.</summary>
        private const int AnswerMs = 12_000;
        private const int RatePauseMs = 1_000;
        private const int Attempts = 3;
        private const int MaxAnswerBytes = 64 << 10;

        private readonly WebEndpoint endpoint;
        private readonly string code;
        private readonly byte[] identity;
        private readonly Pair message;
        private readonly object gate = new object();
        private readonly Thread thread;
        private bool isStopping;
        private bool isOpen;
        private ServerMessage answer;
        private bool isUnreadable;
        private volatile PairingResult result;

        /// <param name="endpoint">With TLS. A pin, if it has one, is checked.</param>
        /// <param name="code">As typed.</param>
        /// <param name="keyHash">C: SHA-256 of our secret.</param>
        /// <param name="name">Of this device, for the list of the session.</param>
        /// <param name="software">Name and version of this software.</param>
        public PairingClient(WebEndpoint endpoint, string code, byte[] keyHash, string name, string software)
        {
            this.endpoint = endpoint;
            this.code = code;
            identity = keyHash;
            message = new Pair { Name = name, Software = software, Identity = keyHash };
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session pair" };
        }

        /// <summary>The result, null while it is not there.</summary>
        public PairingResult Result { get { return result; } }

        public void Start()
        {
            thread.Start();
        }

        /// <summary>End it. Returns within a second, or two while the code is stretched on a slow device: whether its threads have ended.</summary>
        public bool Stop()
        {
            lock (gate)
            {
                isStopping = true;
                Monitor.PulseAll(gate);
            }
            return thread.Join(2_000);
        }

        void ILinkListener.OnOpen(WebSocketLink link)
        {
            Note(() => isOpen = true);
        }

        bool ILinkListener.OnMessage(WebSocketLink link, int channel, ref Multipart received)
        {
            if (channel != WebMessage.Control) return true;
            try
            {
                WireReader reader = new WireReader();
                reader.Reset(received.Buffer, received.OffsetOf(0), received.LengthOf(0));
                ServerMessage read = ServerEnvelope.Read(reader).Message;
                if (read is Paired || read is Refused || read is ProtocolFault) Note(() => answer = read);
            }
            catch (WireException)
            {
                Note(() => isUnreadable = true);
            }
            return true;
        }

        void ILinkListener.OnEnd(WebSocketLink link)
        {
            Note(() => { });
        }

        private void Run()
        {
            PairingResult found = null;
            for (int attempt = 1; found == null; attempt++)
            {
                found = TryAttempt();
                bool isRate = found.Outcome == PairingOutcome.Refused && found.Refusal.Code == RefusalCode.Rate;
                if (!isRate || attempt == Attempts) break;
                lock (gate) if (!isStopping) Monitor.Wait(gate, RatePauseMs);
                if (!isStopping) found = null;
            }
            result = found;
        }

        private PairingResult TryAttempt()
        {
            try
            {
                return Attempt();
            }
            catch (Exception error) // a defect of ours, or what the runtime lacks: the app goes on
            {
                return new PairingResult(PairingOutcome.NoAnswer, end: new LinkEnd(LinkFailure.Protocol, 0, error.Message));
            }
        }

        private PairingResult Attempt()
        {
            if (JoinCode.Normalise(code) == null) return new PairingResult(PairingOutcome.NoCode);
            lock (gate)
            {
                isOpen = isUnreadable = false;
                answer = null;
            }
            WebSocketLink link = new WebSocketLink(endpoint, "/v1/session", MaxAnswerBytes, this, endpoint.Pin == null);
            link.Start();
            try
            {
                return Ask(link);
            }
            finally
            {
                link.Abort();
                link.Join(1_000);
            }
        }

        private PairingResult Ask(WebSocketLink link)
        {
            long untilNs = MonotonicClock.NowNs + AnswerMs * 1_000_000L;
            if (!WaitUntil(link, untilNs, () => isOpen)) return GiveUp(link);
            byte[] s = link.CertificateKey;
            if (s == null) return new PairingResult(PairingOutcome.NotReached, end: new LinkEnd(LinkFailure.NotAGateway, 0, endpoint.Authority + " has no TLS: it needs no pairing"));
            byte[] stretched = JoinCode.Stretch(code, s);
            message.Proof = JoinCode.MakeClientProof(stretched, s, identity);
            byte[] envelope = new ClientEnvelope { Version = Wire.Version, Message = message }.Encode();
            link.TrySend(WebMessage.Control, envelope, envelope.Length);
            if (!WaitUntil(link, untilNs, () => answer != null || isUnreadable)) return GiveUp(link);
            switch (answer)
            {
                case Paired paired:
                    bool isProved = JoinCode.IsSameProof(JoinCode.MakeServerProof(stretched, s, identity), paired.Proof);
                    return isProved
                        ? new PairingResult(PairingOutcome.Paired, endpoint.WithPin(s), paired.Roles)
                        : new PairingResult(PairingOutcome.NotProved);
                case Refused refused:
                    return new PairingResult(PairingOutcome.Refused, refusal: refused);
                case ProtocolFault fault:
                    return new PairingResult(PairingOutcome.Refused, refusal: new Refused { Code = fault.Code, Message = fault.Message });
                default:
                    return new PairingResult(PairingOutcome.NoAnswer);
            }
        }

        private PairingResult GiveUp(WebSocketLink link)
        {
            if (isStopping) return new PairingResult(PairingOutcome.Stopped);
            if (!link.HasEnded) return new PairingResult(PairingOutcome.NoAnswer);
            return new PairingResult(PairingOutcome.NotReached, end: link.End);
        }

        private void Note(Action action)
        {
            lock (gate)
            {
                action();
                Monitor.PulseAll(gate);
            }
        }

        /// <summary>Wait for a condition. False: the link has ended, it was stopped, or the time is over.</summary>
        private bool WaitUntil(WebSocketLink link, long untilNs, Func<bool> condition)
        {
            lock (gate)
            {
                while (!condition())
                {
                    long left = (untilNs - MonotonicClock.NowNs) / 1_000_000;
                    if (isStopping || link.HasEnded || left <= 0) return false;
                    Monitor.Wait(gate, (int)left);
                }
                return true;
            }
        }
    }
}
