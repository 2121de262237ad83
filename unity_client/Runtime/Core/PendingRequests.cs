// Requests that wait for replies, and the e-stop that waits to be seen.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>
    /// Requests that wait for replies, replies to be fetched, and leases that replies granted. Bounded.
    ///
    /// Of one connection: cleared for the next one. Request numbers continue.
    /// </summary>
    public sealed class PendingRequests
    {
        private const int MaxPending = 64;

        /// <summary>Targets named in replies.</summary>
        private const int MaxGranted = 4096;

        private readonly ConnectionCounters counters;

        // In order of arrival: the oldest go first.
        private readonly List<long> pending = new List<long>();
        private readonly List<Reply> replies = new List<Reply>();
        private readonly Dictionary<string, Lease> granted = new Dictionary<string, Lease>();
        private readonly Queue<string> grantedOrder = new Queue<string>();

        internal PendingRequests(ConnectionCounters counters)
        {
            this.counters = counters;
        }

        /// <summary>Number of the next request.</summary>
        public long NextRequest { get; private set; } = 1;

        /// <summary>Return whether a request still waits for its reply.</summary>
        public bool IsPending(long requestId)
        {
            return pending.Contains(requestId);
        }

        /// <summary>Return the reply to a request once, null while there is none.</summary>
        public Reply PopReply(long requestId)
        {
            for (int i = 0; i < replies.Count; i++)
            {
                if (replies[i].RequestId != requestId) continue;
                Reply reply = replies[i];
                replies.RemoveAt(i);
                return reply;
            }
            return null;
        }

        /// <summary>Return the lease in the newest reply that names `target`, or null: it may be ahead of the event.</summary>
        public Lease FindGranted(string target)
        {
            return granted.TryGetValue(target, out Lease lease) ? lease : null;
        }

        /// <summary>Remove everything: requests of another connection get no reply.</summary>
        internal void Clear()
        {
            granted.Clear();
            grantedOrder.Clear();
            pending.Clear();
            replies.Clear();
        }

        /// <summary>Count the request <see cref="NextRequest"/> as sent. Beyond the bound the oldest one is dropped.</summary>
        internal void AddPending()
        {
            if (pending.Count >= MaxPending) pending.RemoveAt(0);
            pending.Add(NextRequest++);
        }

        /// <summary>Store a reply. False: it is a denial of a message that expects no reply, to be passed on otherwise.</summary>
        internal bool ProcessReply(Reply reply)
        {
            foreach (Lease lease in reply.Leases)
            {
                if (!granted.ContainsKey(lease.Target)) grantedOrder.Enqueue(lease.Target);
                granted[lease.Target] = lease;
            }
            while (grantedOrder.Count > MaxGranted) granted.Remove(grantedOrder.Dequeue());
            if (pending.Remove(reply.RequestId))
            {
                replies.Add(reply);
                if (replies.Count > MaxPending)
                {
                    replies.RemoveAt(0);
                    counters.InboxDropped++;
                }
                return true;
            }
            if (reply.RequestId != 0)
            {
                counters.UnexpectedReplies++;
                return true;
            }
            return reply.Denial == null;
        }
    }

    /// <summary>
    /// An e-stop of ours until the session is known to have it: a connection may end with it on the way.
    ///
    /// The session has it when it reports a stop of ours; the stop of another is no proof, as it may be cleared before ours arrives.
    /// When the report was missed, the pong of a ping that was sent after the e-stop proves it too, if the session is stopped.
    /// </summary>
    public sealed class PendingEStop
    {
        private bool hasPing;
        private long proofNs;

        /// <summary>To be sent again on the next connection; null when there is none or the session has it.</summary>
        public EStop Message { get; private set; }

        /// <summary>Keep an e-stop that is sent now, for the first time or again.</summary>
        internal void Begin(EStop message)
        {
            Message = message;
            hasPing = false;
        }

        /// <summary>Forget the e-stop: the user clears it, or the session has it.</summary>
        internal void Withdraw()
        {
            Message = null;
        }

        /// <summary>Note a ping that was queued.</summary>
        internal void OnPing(long t0Ns)
        {
            if (Message == null || hasPing) return;
            hasPing = true;
            proofNs = t0Ns;
        }

        /// <summary>Note the pong of a ping, while the session is stopped as far as we know.</summary>
        internal void OnPong(long t0Ns, bool isStopped)
        {
            if (isStopped && hasPing && t0Ns >= proofNs) Message = null;
        }
    }
}
