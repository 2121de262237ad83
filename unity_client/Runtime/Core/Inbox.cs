// Messages to the application, in order, bounded.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>
    /// An `Event`, `Feedback`, `ProtocolFault`, or the `Reply` that denies a message which expects none; or events that will not be
    /// delivered: a snapshot has their effects.
    /// </summary>
    public readonly struct InboxMessage
    {
        /// <summary>The message, null for events that are missed.</summary>
        public readonly ServerMessage Message;

        /// <summary>First and last `event_seq` of what is missed; of an event its own, else 0.</summary>
        public readonly long First;
        public readonly long Last;

        internal InboxMessage(ServerMessage message)
        {
            Message = message;
            First = Last = message is Event one ? one.EventSeq : 0;
        }

        internal InboxMessage(long first, long last)
        {
            Message = null;
            First = first;
            Last = last;
        }

        /// <summary>True for events that did not arrive.</summary>
        public bool IsMissed { get { return Message == null; } }
    }

    /// <summary>A bounded queue: of one that is not read, the oldest messages are dropped, and events among them named as missed.</summary>
    public sealed class Inbox
    {
        private const int MaxMessages = 1024;

        private readonly Queue<InboxMessage> messages = new Queue<InboxMessage>();
        private readonly ConnectionCounters counters;

        // Events that were dropped from the queue come before what is in it.
        private bool hasMissed;
        private long missedFirst;
        private long missedLast;

        internal Inbox(ConnectionCounters counters)
        {
            this.counters = counters;
        }

        public int Count { get { return messages.Count + (hasMissed ? 1 : 0); } }

        /// <summary>Remove the oldest message. False when there is none.</summary>
        public bool TryTake(out InboxMessage message)
        {
            if (hasMissed)
            {
                hasMissed = false;
                message = new InboxMessage(missedFirst, missedLast);
                return true;
            }
            message = default;
            if (messages.Count == 0) return false;
            message = messages.Dequeue();
            return true;
        }

        internal void Add(InboxMessage message)
        {
            while (Count >= MaxMessages) DropOldest();
            messages.Enqueue(message);
        }

        private void DropOldest()
        {
            InboxMessage dropped = messages.Dequeue();
            if (!dropped.IsMissed) counters.InboxDropped++;
            if (!dropped.IsMissed && !(dropped.Message is Event)) return;
            if (!hasMissed) missedFirst = dropped.First;
            hasMissed = true;
            missedLast = dropped.Last;
        }
    }
}
