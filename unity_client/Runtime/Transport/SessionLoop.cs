// The rounds of a client: state first, then control messages, timers and sending, over any transport. For one thread; no clock of its
// own. SessionClient runs it on a thread.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>Where what a loop receives goes. Called within <see cref="SessionLoop.Step"/>.</summary>
    public interface ISessionListener
    {
        /// <summary>There is a new state: `loop.Connection.Stream`.</summary>
        void OnState(SessionLoop loop);

        /// <summary>Poses of other participants have come: `loop.Connection.Stream.Presence`.</summary>
        void OnPresence(SessionLoop loop);

        /// <summary>A media frame came: topic, `MediaHeader`, bytes. The listener may exchange `message` for another one.</summary>
        void OnMedia(SessionLoop loop, ref Multipart message);

        /// <summary>Words of the gateway for the person.</summary>
        void OnNotice(SessionLoop loop, string text);
    }

    /// <summary>A connection and its transport.</summary>
    public sealed class SessionLoop
    {
        /// <summary>Pause while the transport's queue is full, or it is not open yet: it wakes us when it opens [ns].</summary>
        private const long FullPauseNs = 10_000_000;

        /// <summary>A sample with a closed clutch was sent so lately that we do not move to another address: robots would hold [ns].</summary>
        private const long EngagedNs = 1_000_000_000;

        /// <summary>Control messages that are processed in one round, so that state does not wait for them.</summary>
        private const int MaxControl = 256;

        public readonly ClientConnection Connection;
        public readonly EndpointChooser Endpoints;
        public readonly ITransport Transport;
        public readonly SampleBuilder Samples;
        public readonly ClientAlignment Alignment;
        public readonly ArrivalMeter Meter = new ArrivalMeter();

        /// <summary>What the runtime of the headset reports; it judges every sample.</summary>
        public readonly HeadsetState Headset;

        /// <summary>What is wrong, for people.</summary>
        public readonly ClientAdvice Advice;

        /// <summary>Battery, heat and dropped frames, for the report.</summary>
        public readonly HealthMeter Health = new HealthMeter();

        private readonly Func<long> getNowNs;
        private readonly ISessionListener listener;
        private readonly List<string> wishes = new List<string>();
        private readonly Multipart[] oneState = new Multipart[1];
        private Multipart state = new Multipart();
        private Multipart message = new Multipart();
        private int generation;
        private bool wasJoined; // in this generation
        private bool hasSocket;
        private bool keepsAddress; // the next socket goes to the address that is chosen already
        private DeliveryBudget seenBudget;
        private long budgetEpoch; // connection that has a delivery budget
        private long welcomedEpoch;
        private long engagedAt = long.MinValue / 2;
        private long transportAt = long.MaxValue;
        private bool isWaiting; // messages wait for the transport

        /// <param name="connection">Not opened yet.</param>
        /// <param name="transport">Sockets; the loop does not dispose of them.</param>
        /// <param name="endpoints">Addresses of the session.</param>
        /// <param name="listener">Where what comes goes.</param>
        /// <param name="getNowNs">A monotonic clock.</param>
        public SessionLoop(ClientConnection connection, ITransport transport, EndpointChooser endpoints, ISessionListener listener, Func<long> getNowNs)
        {
            Connection = connection;
            Transport = transport;
            Endpoints = endpoints;
            Samples = new SampleBuilder(connection);
            Alignment = new ClientAlignment(connection);
            Headset = new HeadsetState(connection);
            Advice = new ClientAdvice(connection, Alignment) { Headset = Headset };
            this.listener = listener;
            this.getNowNs = getNowNs;
        }

        /// <summary>
        /// Why we do not try any more until <see cref="Open"/> or <see cref="Trust"/>: a certificate that is not the known one, another version,
        /// or what is not allowed. None while we try.
        /// </summary>
        public LinkEnd Problem { get; private set; }

        /// <summary>How the newest socket that failed ended.</summary>
        public LinkEnd LastEnd { get; private set; }

        /// <summary>Join the session, also after a refusal.</summary>
        public void Open()
        {
            Problem = default;
            Connection.Open(getNowNs());
        }

        /// <summary>Accept the key that the gateway has shown, after the person has compared it, and join.</summary>
        public void Trust(byte[] certificateHash)
        {
            if (Endpoints.Trust(certificateHash) && Problem.Failure != LinkFailure.None) Open();
        }

        /// <summary>Leave the session: leases are released at once.</summary>
        public void Close()
        {
            Connection.Close();
            Flush();
            DropSocket();
        }

        /// <summary>Say that a defect of this program ends the session.</summary>
        internal void NoteDefect()
        {
            Problem = new LinkEnd(LinkFailure.Defect, 0, "a defect of this app has ended the session");
        }

        /// <summary>Become a participant with another hello, such as one with other devices. See <see cref="ClientConnection.Rejoin"/>.</summary>
        public void Rejoin(Hello hello)
        {
            keepsAddress = Connection.IsJoined;
            Connection.Rejoin(hello, getNowNs());
        }

        /// <summary>Set the media streams that are wanted.</summary>
        public void SetMediaWishes(IReadOnlyList<string> streams)
        {
            wishes.Clear();
            wishes.AddRange(streams);
        }

        /// <summary>Send the input of a device.</summary>
        /// <exception cref="InvalidMessageException">The session has no such robot or object.</exception>
        public bool SendSample(SampleInput input)
        {
            if (!Headset.Judge(input)) return false;
            if (input.Device == Device.Head) Advice.Head = input.Pose;
            if (input.Clutch && input.Robots.Count > 0) engagedAt = getNowNs();
            return Connection.Send(Samples.MakeSample(input));
        }

        /// <summary>Run one round. Waits for nothing.</summary>
        public void Step()
        {
            OpenSocket();
            DrainState();
            DrainControl();
            DrainMedia();
            CheckEnd();
            CheckProbe();
            long nowNs = getNowNs();
            Connection.Tick(nowNs);
            Report(nowNs);
            OpenSocket(); // a tick may have begun another connection
            Flush();
            FollowConnection();
            transportAt = Transport.Tick(nowNs);
            if (Connection.Phase == ConnectionPhase.Refused || Connection.Phase == ConnectionPhase.Closed) DropSocket();
        }

        /// <summary>Return how long nothing has to be done unless something comes [ns].</summary>
        public long NextWaitNs()
        {
            long nowNs = getNowNs();
            long due = Connection.NextDeadlineNs(nowNs);
            if (Connection.IsJoined) due = Math.Min(due, Endpoints.NextProbeNs);
            due = Math.Min(due, transportAt);
            if (isWaiting && Transport.State == TransportState.Open) due = Math.Min(due, nowNs + FullPauseNs);
            return Math.Max(0, due - nowNs);
        }

        /// <summary>Note what a message says about robots of ours, before the application takes it.</summary>
        public void Note(ServerMessage message)
        {
            if (message is Feedback feedback)
            {
                Headset.TakeFeedback(feedback);
                Advice.TakeFeedback(feedback);
            }
            else if (message is Reply reply && reply.Denial != null) Advice.TakeDenial(reply.Denial, getNowNs());
        }

        /// <summary>List what is wrong into `advice`, the most urgent first.</summary>
        public void ListAdvice(List<Advice> advice)
        {
            bool showsLast = Problem.Failure == LinkFailure.None && !Connection.IsJoined && Connection.RetryableRefusal == null;
            LinkEnd shown = showsLast ? LastEnd : Problem;
            Advice.Link = LinkWords.OfEnd(shown);
            Advice.IsLinkOfOtherVersion = shown.Failure == LinkFailure.Closed && shown.Code == CloseCode.Version;
            Advice.List(getNowNs(), advice);
        }

        // --- sockets ----------------------------------------------------------------------------------------------------------------

        /// <summary>Open a fresh socket when the connection wants one.</summary>
        private void OpenSocket()
        {
            if (Connection.Generation == generation || Connection.Phase != ConnectionPhase.Joining) return;
            if (hasSocket && !wasJoined) Endpoints.OnFailed(default, getNowNs()); // no answer in time
            else if (hasSocket && !keepsAddress) Endpoints.OnLost();
            keepsAddress = false;
            generation = Connection.Generation;
            wasJoined = false;
            budgetEpoch = 0;
            WebEndpoint endpoint = Endpoints.Choose();
            if (endpoint == null)
            {
                DropSocket();
                Problem = Endpoints.Blocked.Failure != LinkFailure.None ? Endpoints.Blocked : new LinkEnd(LinkFailure.Unreachable, 0, "no address");
                Connection.Suspend();
                return;
            }
            hasSocket = true;
            Transport.Open(endpoint);
        }

        private void DropSocket()
        {
            if (!hasSocket) return;
            hasSocket = false;
            Transport.Close();
        }

        private void CheckEnd()
        {
            if (!hasSocket || Transport.State != TransportState.Closed) return;
            LinkEnd end = Transport.End;
            LastEnd = end;
            hasSocket = false;
            Transport.Close();
            long nowNs = getNowNs();
            int code = end.Failure == LinkFailure.Closed ? end.Code : 0;
            if (code == CloseCode.Version || code == CloseCode.NotAllowed)
            {
                Problem = end;
                Connection.Suspend();
                return;
            }
            if (wasJoined) Endpoints.OnLost();
            else Endpoints.OnFailed(end, nowNs);
            if (code == CloseCode.Flood) Connection.HandleUnreachable(nowNs, true);
            else if (Connection.IsJoined) Connection.HandleDisconnect(nowNs);
            else Connection.HandleUnreachable(nowNs);
        }

        /// <summary>Move to a better address when one answers, but not while a robot follows.</summary>
        private void CheckProbe()
        {
            long nowNs = getNowNs();
            bool canMove = Connection.IsJoined && nowNs - engagedAt >= EngagedNs;
            if (Transport.TryTakeProbe(out ProbeAnswer answer) && Endpoints.OnProbe(answer, canMove ? Connection.Welcome.SessionId : "", nowNs))
            {
                keepsAddress = true;
                Connection.HandleDisconnect(nowNs);
                return;
            }
            if (!canMove) return;
            WebEndpoint better = Endpoints.TakeProbe(nowNs);
            if (better != null) Transport.StartProbe(better);
        }

        // --- what comes -------------------------------------------------------------------------------------------------------------

        private void DrainState()
        {
            StateStream stream = Connection.Stream;
            while (Transport.TryTakeState(ref state))
            {
                oneState[0] = state;
                long nowNs = getNowNs();
                if (!stream.Drain(oneState, Connection.Clock.SessionNs(nowNs), nowNs)) continue;
                Meter.RecordState(stream);
                if (Connection.Clock.IsSynced) listener.OnState(this);
            }
            if (stream.Presence.TakeNews()) listener.OnPresence(this);
        }

        private void DrainControl()
        {
            for (int i = 0; i < MaxControl && Transport.TryTakeControl(ref message); i++)
            {
                Connection.Receive(message, getNowNs()); // after it came: a pong stamped too early would understate its round trip
                OnReceived();
            }
            string notice = Transport.TakeNotice();
            if (notice != null) listener.OnNotice(this, notice);
        }

        private void OnReceived()
        {
            if (!Connection.IsJoined) return;
            wasJoined = true;
            if (Connection.ConnectionEpoch == welcomedEpoch) return;
            welcomedEpoch = Connection.ConnectionEpoch;
            Endpoints.OnJoined();
            Meter.Restart();
            seenBudget = Connection.Budget; // of the connection before
        }

        private void DrainMedia()
        {
            while (Transport.TryTakeMedia(ref message)) listener.OnMedia(this, ref message);
        }

        // --- what goes --------------------------------------------------------------------------------------------------------------

        private void Report(long nowNs)
        {
            if (!Connection.IsJoined) return;
            ClientReport report = Meter.Poll(Connection.Stream, Connection.Clock.RttNs, nowNs);
            if (report == null) return;
            Health.Fill(report);
            Connection.Send(report);
        }

        private void Flush()
        {
            isWaiting = false;
            for (Outgoing item = Connection.PeekOutgoing(); item != null; item = Connection.PeekOutgoing())
            {
                bool isSent = Transport.TrySend(item.Bytes, item.Count);
                isWaiting = !isSent && !item.IsDroppable;
                if (isWaiting) return;
                Connection.PopOutgoing(isSent);
            }
        }

        private void FollowConnection()
        {
            if (Connection.IsJoined && Connection.Budget != seenBudget) budgetEpoch = Connection.ConnectionEpoch;
            Transport.SetMedia(wishes, Connection.IsJoined ? budgetEpoch : 0);
        }
    }
}
