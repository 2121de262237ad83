// Messages that a client sends: the bounded queue, and what is counted of a connection.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Counters of the control channel, since the client was made.</summary>
    public sealed class ConnectionCounters
    {
        private const int MaxCodes = 64;

        /// <summary>By `ProtocolFault.Code`, beyond 64 as `other`.</summary>
        public readonly Dictionary<string, long> Faults = new Dictionary<string, long>();
        public long Sent;
        public long Received;

        /// <summary>No connection, or the socket was full: late samples are worthless, they are not kept.</summary>
        public long SamplesNotSent;

        /// <summary>Named a robot or object that is not ours: sent as mere presence, without it.</summary>
        public long SamplesWithoutLease;
        public long OutgoingDropped;
        public long Malformed;

        /// <summary>Addressed to an earlier connection of ours.</summary>
        public long OtherConnection;
        public long UnexpectedReplies;
        public long UnaskedDenials;
        public long InboxDropped;
        public long Snapshots;
        public long Reconnects;

        internal void CountFault(string code)
        {
            string name = Faults.ContainsKey(code) || Faults.Count < MaxCodes ? code : "other";
            Faults.TryGetValue(name, out long count);
            Faults[name] = count + 1;
        }
    }

    /// <summary>A message that waits: the first `Count` of `Bytes`. A sample may be dropped when the socket is full.</summary>
    public sealed class Outgoing
    {
        public byte[] Bytes = new byte[256];
        public int Count;
        public bool IsDroppable;
    }

    /// <summary>
    /// Bounded queue. Drops are counted. Buffers are used again, so that samples allocate nothing.
    ///
    /// An e-stop passes everything but a hello. A release passes samples only: it may refer to an acquire before it.
    /// </summary>
    internal sealed class Outbox
    {
        /// <summary>Messages that may wait for the socket.</summary>
        public const int MaxOutgoing = 256;

        /// <summary>Buffers above this size are not kept.</summary>
        private const int MaxKeptBytes = 8192;

        private readonly ConnectionCounters counters;
        private readonly Stack<Outgoing> free = new Stack<Outgoing>(MaxOutgoing);

        // A ring: begin, and count messages from there.
        private readonly Outgoing[] queue = new Outgoing[MaxOutgoing];
        private int begin;
        private int count;
        private bool hasHello; // always as the first

        public Outbox(ConnectionCounters counters)
        {
            this.counters = counters;
        }

        /// <summary>Queue a copy of the bytes, which are the message `type`. False: the queue is full, and the message is not urgent.</summary>
        public bool Push(string type, byte[] bytes, int length)
        {
            bool droppable = type == Sample.TagName || type == Samples.TagName;
            if (count == MaxOutgoing)
            {
                if (type != EStop.TagName && type != Release.TagName && type != Bye.TagName)
                {
                    CountDrop(droppable);
                    return false;
                }
                MakeRoom();
            }
            int at = count;
            if (type == EStop.TagName) at = hasHello ? 1 : 0;
            else if (type == Release.TagName) while (at > 0 && Slot(at - 1).IsDroppable) at--;
            else if (type == Hello.TagName) hasHello = true;
            Insert(at, droppable, bytes, length);
            return true;
        }

        /// <summary>Return the next message to send, null when the queue is empty. Valid until the next call.</summary>
        public Outgoing Peek()
        {
            return count == 0 ? null : queue[begin];
        }

        /// <summary>Remove the message of <see cref="Peek"/>, which was sent or is dropped.</summary>
        public void Pop(bool sent)
        {
            if (count == 0) return;
            Keep(queue[begin]);
            begin = (begin + 1) % MaxOutgoing;
            count--;
            hasHello = false;
            if (sent) counters.Sent++;
            else counters.SamplesNotSent++;
        }

        /// <summary>Empty the queue: its messages are not for the next connection.</summary>
        public void Clear()
        {
            for (; count > 0; count--) Keep(Slot(count - 1));
            hasHello = false;
        }

        private Outgoing Slot(int index)
        {
            return queue[(begin + index) % MaxOutgoing];
        }

        private void Insert(int at, bool droppable, byte[] bytes, int length)
        {
            Outgoing item = free.Count > 0 ? free.Pop() : new Outgoing();
            if (item.Bytes.Length < length) item.Bytes = new byte[Math.Max(length + length / 2, 256)]; // room for numbers that grow
            Buffer.BlockCopy(bytes, 0, item.Bytes, 0, length);
            item.Count = length;
            item.IsDroppable = droppable;
            for (int i = count; i > at; i--) queue[(begin + i) % MaxOutgoing] = Slot(i - 1);
            queue[(begin + at) % MaxOutgoing] = item;
            count++;
        }

        /// <summary>Drop the newest sample; without any, the newest message.</summary>
        private void MakeRoom()
        {
            int at = count - 1;
            while (at >= 0 && !Slot(at).IsDroppable) at--;
            if (at < 0) at = count - 1;
            CountDrop(Slot(at).IsDroppable);
            Keep(Slot(at));
            for (int i = at; i < count - 1; i++) queue[(begin + i) % MaxOutgoing] = Slot(i + 1);
            count--;
        }

        private void Keep(Outgoing item)
        {
            if (item.Bytes.Length <= MaxKeptBytes) free.Push(item);
        }

        private void CountDrop(bool sample)
        {
            if (sample) counters.SamplesNotSent++;
            else counters.OutgoingDropped++;
        }
    }
}
