// Queues between the threads of sockets and the thread that takes what came. Messages are exchanged, not copied.
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Messages in order, bounded by number and bytes. For any threads.</summary>
    internal sealed class MessageQueue
    {
        /// <summary>Buffers above this size are not kept.</summary>
        private const int MaxKeptBytes = 16 << 10;

        private readonly int maxCount;
        private readonly long maxBytes;
        private readonly Queue<Multipart> waiting = new Queue<Multipart>();
        private readonly Stack<Multipart> free = new Stack<Multipart>();
        private long bytes;

        public MessageQueue(int maxCount, long maxBytes)
        {
            this.maxCount = maxCount;
            this.maxBytes = maxBytes;
        }

        /// <summary>Add a message in exchange for an empty one. False: the queue is full.</summary>
        public bool TryAdd(ref Multipart message)
        {
            lock (waiting)
            {
                if (waiting.Count > 0 && (waiting.Count >= maxCount || bytes + message.TotalBytes > maxBytes)) return false;
                waiting.Enqueue(message);
                bytes += message.TotalBytes;
                message = free.Count > 0 ? free.Pop() : new Multipart();
                return true;
            }
        }

        /// <summary>Take the oldest message in exchange for `message`. False: there is none.</summary>
        public bool TryTake(ref Multipart message)
        {
            lock (waiting)
            {
                if (waiting.Count == 0) return false;
                Multipart taken = waiting.Dequeue();
                bytes -= taken.TotalBytes;
                if (message.Buffer.Length <= MaxKeptBytes && free.Count < 16) free.Push(message);
                message = taken;
                return true;
            }
        }

        public void Clear()
        {
            lock (waiting)
            {
                waiting.Clear();
                bytes = 0;
            }
        }
    }

    /// <summary>The newest message of each topic. For any threads.</summary>
    internal sealed class NewestMessages
    {
        private sealed class Slot
        {
            public Multipart Message = new Multipart();
            public bool IsFresh;
        }

        private readonly int maxTopics;
        private readonly bool endsAtSlash;
        private readonly List<Slot> slots = new List<Slot>();
        private int next;

        /// <param name="maxTopics">Topics beyond this number are dropped.</param>
        /// <param name="endsAtSlash">The last part of a topic, behind `/`, does not distinguish.</param>
        public NewestMessages(int maxTopics, bool endsAtSlash)
        {
            this.maxTopics = maxTopics;
            this.endsAtSlash = endsAtSlash;
        }

        /// <summary>Messages that were replaced before they were taken, or dropped.</summary>
        public long Superseded { get; private set; }

        /// <summary>Keep a message in exchange for an older one.</summary>
        public void Put(ref Multipart message)
        {
            lock (slots)
            {
                Slot slot = Find(message);
                if (slot == null)
                {
                    Superseded++;
                    return;
                }
                if (slot.IsFresh) Superseded++;
                Multipart before = slot.Message;
                slot.Message = message;
                slot.IsFresh = true;
                message = before;
            }
        }

        /// <summary>Take the newest message of some topic, by turns, in exchange for `message`. False: nothing is fresh.</summary>
        public bool TryTake(ref Multipart message)
        {
            lock (slots)
            {
                for (int i = 0; i < slots.Count; i++)
                {
                    next = (next + 1) % slots.Count;
                    Slot slot = slots[next];
                    if (!slot.IsFresh) continue;
                    Multipart taken = slot.Message;
                    slot.Message = message;
                    slot.IsFresh = false;
                    message = taken;
                    return true;
                }
                return false;
            }
        }

        /// <summary>Like <see cref="TryTake"/>, and false while another thread is here.</summary>
        public bool TryTakeAtOnce(ref Multipart message)
        {
            if (!Monitor.TryEnter(slots)) return false;
            try
            {
                return TryTake(ref message);
            }
            finally
            {
                Monitor.Exit(slots);
            }
        }

        /// <summary>Forget what was not taken.</summary>
        public void Clear()
        {
            lock (slots) slots.Clear();
        }

        private Slot Find(Multipart message)
        {
            foreach (Slot slot in slots) if (slot.IsFresh && HasSameTopic(slot.Message, message)) return slot;
            foreach (Slot slot in slots) if (!slot.IsFresh) return slot;
            if (slots.Count == maxTopics) return null;
            Slot added = new Slot();
            slots.Add(added);
            return added;
        }

        private bool HasSameTopic(Multipart a, Multipart b)
        {
            if (a.Count == 0 || b.Count == 0) return a.Count == b.Count;
            int length = LengthOfTopic(a);
            if (length != LengthOfTopic(b)) return false;
            for (int i = 0; i < length; i++) if (a.Buffer[a.OffsetOf(0) + i] != b.Buffer[b.OffsetOf(0) + i]) return false;
            return true;
        }

        private int LengthOfTopic(Multipart message)
        {
            int length = message.LengthOf(0);
            if (!endsAtSlash) return length;
            int at = length;
            while (at > 0 && message.Buffer[message.OffsetOf(0) + at - 1] != '/') at--;
            return at == 0 ? length : at;
        }
    }
}
