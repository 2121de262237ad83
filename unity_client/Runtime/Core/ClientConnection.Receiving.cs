using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    public sealed partial class ClientConnection
    {
        /// <summary>Heartbeat periods that a session may ask for: with others a client would never rest, or never notice its end.</summary>
        private const long HeartbeatMinNs = 20_000_000;
        private const long HeartbeatMaxNs = 10_000_000_000;

        /// <summary>Reason of a drop after another connection resumed this one. Joining again would only take it back in turn.</summary>
        internal const string Replaced = "replaced";

        private readonly List<InboxMessage> applied = new List<InboxMessage>();

        /// <summary>Process one message of the control channel: envelope, then bulk frames.</summary>
        public void Receive(Multipart message, long nowNs)
        {
            ServerMessage received;
            long epoch;
            try
            {
                if (message.Count == 0) throw new WireException("a message without frames");
                received = codec.DecodeServer(message.Buffer, message.OffsetOf(0), message.LengthOf(0), out epoch);
            }
            catch (WireException)
            {
                Counters.Malformed++;
                return;
            }
            Counters.Received++;
            heardAt = nowNs;
            switch (received)
            {
                case Welcome welcome:
                    ProcessWelcome(welcome, nowNs);
                    break;
                case Refused refused:
                    ProcessRefusal(refused, nowNs);
                    break;
                case ProtocolFault fault:
                    ProcessFault(fault, nowNs);
                    break;
                default:
                    if (!IsJoined || epoch != ConnectionEpoch) Counters.OtherConnection++;
                    else Process(received, message, nowNs);
                    break;
            }
        }

        private void Process(ServerMessage received, Multipart message, long nowNs)
        {
            switch (received)
            {
                case ClockPong pong:
                    Clock.ProcessPong(pong.T0Ns, pong.T1Ns, pong.T2Ns, nowNs);
                    PendingEStop.OnPong(pong.T0Ns, Mirror.IsSynced && Mirror.IsStopped);
                    UpdateReady();
                    break;
                case Reply reply:
                    if (Requests.ProcessReply(reply)) break;
                    Counters.UnaskedDenials++;
                    Inbox.Add(new InboxMessage(reply));
                    break;
                case Event one:
                    ProcessEvent(one, nowNs);
                    break;
                case Snapshot snapshot:
                    ProcessSnapshot(snapshot, message);
                    break;
                case Feedback feedback:
                    Inbox.Add(new InboxMessage(feedback));
                    break;
                case DeliveryBudget budget:
                    Budget = budget;
                    break;
            }
        }

        private void ProcessWelcome(Welcome welcome, long nowNs)
        {
            if (Phase != ConnectionPhase.Joining)
            {
                Counters.OtherConnection++;
                return;
            }
            if (Welcome == null || welcome.SessionId != Welcome.SessionId)
            {
                Mirror.Reset();
                Clock.Reset();
                Stream.Reset(); // else state continues: a restarted front numbers its frames above the old one's
            }
            Clock.Restart(); // this machine may have slept
            Stream.Restart();
            Mirror.IsSynced = false;
            Welcome = welcome;
            RetryableRefusal = null;
            Identity.Remember(welcome.ResumeToken);
            Phase = ConnectionPhase.Syncing;
            joinedAt = nowNs;
            heartbeatNs = Math.Min(Math.Max(welcome.HeartbeatNs, HeartbeatMinNs), HeartbeatMaxNs);
            heartbeatAt = nowNs + heartbeatNs / 2;
            snapshotAt = nowNs;
            if (PendingEStop.Message != null)
            {
                PendingEStop.Begin(PendingEStop.Message);
                Queue(PendingEStop.Message);
            }
            if (TrackingEpoch > 0) Queue(new TrackingEpoch { TrackingEpochValue = TrackingEpoch });
            if (!IsWorn) SendHeartbeat();
            SendPeriodic(nowNs);
        }

        private void ProcessRefusal(Refused refused, long nowNs)
        {
            if (Phase != ConnectionPhase.Joining) return;
            if (refused.Code == RefusalCode.ResumeToken && Identity.ResumeToken.Length > 0)
            {
                Identity.Remember(new byte[0]); // used up or removed: join as a new participant
                SendHello(nowNs);
            }
            else if (IsRetryable(refused.Code))
            {
                RetryableRefusal = refused;
                StartBackoff(nowNs);
            }
            else Fail(refused);
        }

        /// <summary>Return whether a refusal passes: a client that was joined before keeps trying, after `rate` every client does.</summary>
        private bool IsRetryable(string code)
        {
            return code == RefusalCode.Rate || (Welcome != null && (code == RefusalCode.Full || code == DenialReason.SessionFull));
        }

        private void Fail(Refused refused)
        {
            Failure = refused;
            Phase = ConnectionPhase.Refused;
        }

        private void ProcessFault(ProtocolFault fault, long nowNs)
        {
            Counters.CountFault(fault.Code);
            Inbox.Add(new InboxMessage(fault));
            switch (fault.Code)
            {
                case FaultCode.Stalled:
                    IsStalled = true;
                    break;
                case FaultCode.Recovered:
                    IsStalled = false;
                    break;
                case FaultCode.Revoked:
                    Fail(new Refused { Code = fault.Code, Message = fault.Message, Advice = "ask the owner of the session" });
                    break;
                case FaultCode.Dropped when fault.Reason == Replaced:
                    Fail(new Refused { Code = Replaced, Message = "another device took over with this identity", Advice = "give every headset an identity of its own" });
                    break;
                case FaultCode.SessionEnded:
                    if (!IsJoined) break;
                    Counters.Reconnects++;
                    StartBackoff(nowNs);
                    break;
                case FaultCode.Dropped:
                case FaultCode.Hello:
                    HandleDisconnect(nowNs);
                    break;
            }
        }

        private void ProcessEvent(Event one, long nowNs)
        {
            bool isNext = Mirror.ApplyEvent(one);
            if (isNext)
            {
                Stream.SceneEpoch = Mirror.BodiesUntil;
                // Another scene: its bodies are requested at once, however lately others were.
                if (!Mirror.IsSynced) snapshotAt = Math.Min(snapshotAt, nowNs);
                if (one.Body is EStopChanged stop && stop.Active && stop.Participant == ParticipantId) PendingEStop.Withdraw();
                Deliver(new InboxMessage(one));
            }
        }

        private void ProcessSnapshot(Snapshot snapshot, Multipart message)
        {
            int bodyCount = snapshot.Bodies.Length;
            if (message.Count < 2 || message.LengthOf(1) != 56L * bodyCount || bodyCount > ushort.MaxValue)
            {
                Counters.Malformed++;
                return;
            }
            Counters.Snapshots++;
            applied.Clear();
            Mirror.ApplySnapshot(snapshot, applied);
            foreach (InboxMessage one in applied) Deliver(one);
            applied.Clear();
            Stream.SceneEpoch = Mirror.BodiesUntil;
            Stream.Presence.Retain(Mirror);
            Stream.LoadKeyframe(snapshot.StateSeq, bodyCount, message.Buffer, message.OffsetOf(1), message.LengthOf(1));
            UpdateReady();
        }

        private void UpdateReady()
        {
            if (Phase == ConnectionPhase.Syncing && Mirror.IsSynced && Clock.IsSettled) Phase = ConnectionPhase.Ready;
        }

        private void Deliver(InboxMessage message)
        {
            if (message.Message is Event one && one.Body is ParticipantLeft left) Stream.Presence.Remove(left.Participant);
            Inbox.Add(message);
        }
    }
}
