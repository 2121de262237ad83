// Connection of one participant: bytes and times in, bytes and messages out, over any number of sockets.
//
//     Idle --Open()--> Joining --welcome--> Syncing --snapshot and clock--> Ready
//     Joining, Syncing, Ready --silence, disconnect, session_ended--> Waiting (back-off, none at first) --> Joining
//     Joining --refused--> Refused (`Failure` holds the reason)          any --Close()--> Closed
//     Joining --refused for now (too many at once)--> Waiting (`RetryableRefusal` holds the reason)
//
// The shell opens a fresh socket whenever `Generation` changes, passes received messages to `Receive`, calls `Tick` at the latest at
// `NextDeadlineNs`, and sends what `PeekOutgoing` shows. All `nowNs` are one monotonic clock. Nothing that a server sends throws here:
// what does not fit the protocol is counted. What is received is in ClientConnection.Receiving.cs.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>State of a connection.</summary>
    public enum ConnectionPhase
    {
        Idle,
        Joining,
        Syncing,
        Ready,
        Waiting,
        Refused,
        Closed,
    }

    /// <summary>Secret and last resume token of a client.</summary>
    public interface IIdentityStore
    {
        /// <summary>16 random bytes at least, made once; behind a web gateway 32.</summary>
        byte[] Secret { get; }

        /// <summary>Token of the last welcome, single use; empty: join as a new participant.</summary>
        byte[] ResumeToken { get; }

        /// <summary>Set <see cref="ResumeToken"/>. Called on the thread of the connection; must not throw.</summary>
        void Remember(byte[] token);
    }

    /// <summary>One participant's connection, over any number of sockets. For one thread.</summary>
    public sealed partial class ClientConnection
    {
        /// <summary>Time to wait for the reply to hello, at first and at most: over a slow link the first attempts are too short.</summary>
        private const long HelloTimeoutNs = 1_000_000_000;
        private const long HelloTimeoutMaxNs = 4_000_000_000;
        private const long BackoffMinNs = 100_000_000;
        private const long BackoffMaxNs = 2_000_000_000;

        /// <summary>Longest pause while no gateway answers: it is back within seconds when it was restarted.</summary>
        private const long UnreachableNs = 500_000_000;
        private const long SteadyNs = 1_000_000_000;
        private const long SnapshotRetryNs = 500_000_000;

        /// <summary>Characters of the reason of an e-stop (docs/protocol.md).</summary>
        private const int MaxReason = 512;

        /// <summary>Heartbeat periods without a message from the session: the connection is lost.</summary>
        private const int SilentHeartbeats = 4;

        public readonly IIdentityStore Identity;
        public readonly SessionMirror Mirror = new SessionMirror();
        public readonly ClockSync Clock = new ClockSync();
        public readonly StateStream Stream = new StateStream();
        public readonly ConnectionCounters Counters = new ConnectionCounters();
        public readonly PendingRequests Requests;
        public readonly PendingEStop PendingEStop = new PendingEStop();
        public readonly Inbox Inbox;
        private readonly MessageCodec codec = new MessageCodec();
        private readonly Outbox outbox;
        private readonly ClockPing ping = new ClockPing();
        private readonly Heartbeat heartbeat = new Heartbeat();
        private Hello hello;
        private long backoffNs = BackoffMinNs;
        private long helloAt;
        private long helloWaitNs = HelloTimeoutNs;
        private long retryAt;
        private long heardAt;
        private long heartbeatAt;
        private long heartbeatNs; // as the session asks for, bounded
        private long snapshotAt;
        private long joinedAt;
        private long tickedAt;

        /// <param name="hello">Role, name, software, devices, capabilities (`run:ID` of one that tracks). Secret and token are filled in.</param>
        /// <param name="identity">Where secret and resume token are kept.</param>
        public ClientConnection(Hello hello, IIdentityStore identity)
        {
            this.hello = hello;
            Identity = identity;
            Requests = new PendingRequests(Counters);
            Inbox = new Inbox(Counters);
            outbox = new Outbox(Counters);
        }

        public ConnectionPhase Phase { get; private set; }

        /// <summary>Number of the socket that is wanted, from 1.</summary>
        public int Generation { get; private set; }

        /// <summary>The newest welcome, null before the first.</summary>
        public Welcome Welcome { get; private set; }

        /// <summary>Why the client must not join again by itself, null while it may.</summary>
        public Refused Failure { get; private set; }

        /// <summary>The newest refusal that passes, until a session welcomes us; else null.</summary>
        public Refused RetryableRefusal { get; private set; }

        /// <summary>True while the session has stopped stepping.</summary>
        public bool IsStalled { get; private set; }

        /// <summary>What this client gets of the media streams, null before the first.</summary>
        public DeliveryBudget Budget { get; private set; }

        /// <summary>Whether the headset is worn: samples and heartbeats carry it. See <see cref="SetWorn"/>.</summary>
        public bool IsWorn { get; private set; } = true;

        /// <summary>Counts jumps of the tracking frame. See <see cref="ReportTrackingJump"/>.</summary>
        public long TrackingEpoch { get; private set; }

        /// <summary>True while the session has accepted us and the connection stands as far as we know.</summary>
        public bool IsJoined { get { return Phase == ConnectionPhase.Syncing || Phase == ConnectionPhase.Ready; } }

        /// <summary>Our id in the session, empty before the first welcome.</summary>
        public string ParticipantId { get { return Welcome == null ? "" : Welcome.ParticipantId; } }

        /// <summary>Number of this connection in the session, 0 before the first welcome.</summary>
        public long ConnectionEpoch { get { return Welcome == null ? 0 : Welcome.ConnectionEpoch; } }

        /// <summary>Start to join, also after a refusal.</summary>
        public void Open(long nowNs)
        {
            Failure = RetryableRefusal = null;
            backoffNs = BackoffMinNs;
            helloWaitNs = HelloTimeoutNs;
            SendHello(nowNs);
        }

        /// <summary>Become a participant with another hello, such as one with other devices: the same one, which keeps its leases.</summary>
        public void Rejoin(Hello hello, long nowNs)
        {
            this.hello = hello;
            if (IsJoined || Phase == ConnectionPhase.Joining) SendHello(nowNs);
        }

        /// <summary>Queue a bye, which releases leases at once. Send what <see cref="PeekOutgoing"/> still shows.</summary>
        public void Close()
        {
            if (IsJoined) // else the session does not hear it, and the next connection resumes this one
            {
                Queue(new Bye());
                Identity.Remember(new byte[0]);
            }
            Phase = ConnectionPhase.Closed;
        }

        /// <summary>Join again, at once if this connection was steady: the socket lost its peer, or the session forgot us.</summary>
        public void HandleDisconnect(long nowNs)
        {
            if (!IsJoined) return;
            Counters.Reconnects++;
            helloWaitNs = HelloTimeoutNs;
            if (nowNs - joinedAt < SteadyNs)
            {
                StartBackoff(nowNs);
                return;
            }
            backoffNs = BackoffMinNs;
            SendHello(nowNs);
        }

        /// <summary>
        /// Wait and join again: the socket could not be opened, was closed before the session answered, or was closed because this client
        /// did too much (`later`).
        /// </summary>
        public void HandleUnreachable(long nowNs, bool later = false)
        {
            if (Phase != ConnectionPhase.Joining && !IsJoined) return;
            if (IsJoined) Counters.Reconnects++;
            helloWaitNs = HelloTimeoutNs;
            StartBackoff(nowNs);
            retryAt = later ? nowNs + BackoffMaxNs : Math.Min(retryAt, nowNs + UnreachableNs);
        }

        /// <summary>Stop trying until <see cref="Open"/>: what is in the way is no session, such as another certificate. The token is kept.</summary>
        public void Suspend()
        {
            Phase = ConnectionPhase.Idle;
            outbox.Clear();
            Requests.Clear();
        }

        /// <summary>Do everything that depends on time: hello, back-off, clock, heartbeat, snapshot, silence.</summary>
        public void Tick(long nowNs)
        {
            if (nowNs - tickedAt > SteadyNs) heardAt = nowNs; // we stood still: messages of that time are still to be read
            tickedAt = nowNs;
            if (Phase == ConnectionPhase.Waiting && nowNs >= retryAt) SendHello(nowNs);
            else if (Phase == ConnectionPhase.Joining && nowNs >= helloAt + helloWaitNs)
            {
                helloWaitNs = Math.Min(2 * helloWaitNs, HelloTimeoutMaxNs);
                StartBackoff(nowNs);
            }
            else if (IsJoined) SendPeriodic(nowNs);
        }

        /// <summary>Return the latest time at which <see cref="Tick"/> must be called.</summary>
        public long NextDeadlineNs(long nowNs)
        {
            if (Phase == ConnectionPhase.Waiting) return retryAt;
            if (Phase == ConnectionPhase.Joining) return helloAt + helloWaitNs;
            if (!IsJoined) return nowNs + SteadyNs;
            long due = Math.Min(Clock.NextPingNs, Math.Min(heartbeatAt, heardAt + SilenceNs));
            return NeedsSnapshot ? Math.Min(due, snapshotAt) : due;
        }

        /// <summary>Return one line for people: why there is no connection now.</summary>
        public string Describe()
        {
            switch (Phase)
            {
                case ConnectionPhase.Waiting:
                case ConnectionPhase.Joining:
                    if (RetryableRefusal != null) return "not let in yet, trying again: " + RetryableRefusal.Message;
                    return Welcome == null ? "no session has answered yet" : "the connection was lost; joining again";
                case ConnectionPhase.Idle:
                    return "not connected";
                case ConnectionPhase.Closed:
                    return "this client was closed";
                default:
                    if (Failure == null) return "connected";
                    return Failure.Advice.Length == 0 ? Failure.Message : Failure.Message + "; " + Failure.Advice;
            }
        }

        /// <summary>Say whether the headset is worn: off the head, or with the app in the background, robots hold. Told at once.</summary>
        public void SetWorn(bool isWorn)
        {
            if (isWorn == IsWorn) return;
            IsWorn = isWorn;
            if (IsJoined) SendHeartbeat();
        }

        /// <summary>
        /// Report that the tracking frame jumped, as after recentring or lost tracking: our alignment is void, engagements end. Call it
        /// before anything is sent that was measured in the new frame.
        /// </summary>
        public void ReportTrackingJump()
        {
            TrackingEpoch++;
            if (IsJoined) Queue(new TrackingEpoch { TrackingEpochValue = TrackingEpoch });
        }

        /// <summary>
        /// Queue a message that expects no reply.
        ///
        /// Samples are never kept: without a connection they are dropped and counted. An e-stop is kept until the session has it, over any
        /// number of connections.
        /// </summary>
        /// <returns>False when the message was dropped, or is an e-stop without a connection yet.</returns>
        /// <exception cref="NotConnectedException">For messages other than those two.</exception>
        public bool Send(ClientMessage message)
        {
            if (message is EStop stop && (IsJoined || Phase == ConnectionPhase.Joining || Phase == ConnectionPhase.Waiting))
            {
                PendingEStop.Begin(Fit(stop));
                return Phase != ConnectionPhase.Waiting && Queue(PendingEStop.Message);
            }
            if (IsJoined) return Queue(message);
            if (!(message is Sample) && !(message is Samples)) throw new NotConnectedException(Describe());
            Counters.SamplesNotSent++;
            return false;
        }

        /// <summary>Queue a request under a fresh `request_id`, which is returned; `Requests.PopReply` has the reply.</summary>
        /// <exception cref="NotConnectedException">There is no connection, or the session is not reading.</exception>
        public long Request(ClientMessage message)
        {
            if (!IsJoined) throw new NotConnectedException(Describe());
            long requestId = Requests.NextRequest;
            RequestIds.Set(message, requestId);
            if (!Queue(message)) throw new NotConnectedException("send queue full (" + Outbox.MaxOutgoing + " messages): the session is not reading");
            if (message is ClearEStop) PendingEStop.Withdraw();
            Requests.AddPending();
            return requestId;
        }

        /// <summary>Return the next message to send, null when there is none. Valid until the next call.</summary>
        public Outgoing PeekOutgoing()
        {
            return outbox.Peek();
        }

        /// <summary>Remove the message of <see cref="PeekOutgoing"/>, which was sent or is dropped.</summary>
        public void PopOutgoing(bool sent)
        {
            outbox.Pop(sent);
        }

        /// <summary>Return our fencing token for `target`, by events or by a reply that came before its event; -1 when it is not ours.</summary>
        public long FindLeaseVersion(string target)
        {
            Lease granted = Requests.FindGranted(target);
            if (granted != null && (!Mirror.Leases.TryGetValue(target, out Lease known) || granted.LeaseVersion > known.LeaseVersion))
            {
                return SessionMirror.IsHeldBy(granted, ParticipantId) ? granted.LeaseVersion : -1;
            }
            return Mirror.FindLeaseVersion(target, ParticipantId);
        }

        private long SilenceNs { get { return SilentHeartbeats * Math.Max(heartbeatNs, 500_000_000); } }

        private bool NeedsSnapshot { get { return !Mirror.IsSynced || Stream.WantsSnapshot; } }

        private void SendPeriodic(long nowNs)
        {
            if (nowNs - heardAt >= SilenceNs)
            {
                HandleDisconnect(nowNs);
                return;
            }
            if (Clock.PollPing(nowNs))
            {
                ping.T0Ns = nowNs;
                Queue(ping);
                PendingEStop.OnPing(nowNs);
            }
            if (nowNs >= heartbeatAt)
            {
                heartbeatAt = nowNs + heartbeatNs / 2;
                SendHeartbeat();
            }
            if (NeedsSnapshot && nowNs >= snapshotAt)
            {
                snapshotAt = nowNs + SnapshotRetryNs;
                Queue(new GetSnapshot());
            }
        }

        private void SendHeartbeat()
        {
            heartbeat.Worn = IsWorn;
            Queue(heartbeat);
        }

        /// <summary>Begin a fresh socket with a hello: no message of an earlier connection can reach the session.</summary>
        private void SendHello(long nowNs)
        {
            Generation++;
            Phase = ConnectionPhase.Joining;
            IsStalled = false;
            helloAt = nowNs;
            heardAt = nowNs;
            outbox.Clear();
            Requests.Clear();
            Queue(MessageCodec.WithIdentity(hello, Identity.Secret, Identity.ResumeToken), 0);
            if (PendingEStop.Message != null) Queue(PendingEStop.Message, 0); // every client may stop, however early
        }

        /// <summary>Return an e-stop that a session accepts: one with a reason that is too long, or without one, must not be refused for that.</summary>
        private static EStop Fit(EStop stop)
        {
            string reason = stop.Reason ?? "";
            if (reason.Length > MaxReason) reason = reason.Substring(0, MaxReason);
            return new EStop { Reason = reason };
        }

        private void StartBackoff(long nowNs)
        {
            Phase = ConnectionPhase.Waiting;
            outbox.Clear();
            retryAt = nowNs + backoffNs;
            backoffNs = Math.Min(2 * backoffNs, BackoffMaxNs);
        }

        private bool Queue(ClientMessage message)
        {
            return Queue(message, ConnectionEpoch);
        }

        private bool Queue(ClientMessage message, long connectionEpoch)
        {
            codec.Encode(message, connectionEpoch);
            return outbox.Push(message.Tag, codec.Bytes, codec.Length);
        }
    }
}
