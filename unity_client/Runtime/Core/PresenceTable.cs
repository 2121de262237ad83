// Heads and hands of the other participants, from the presence topic of the state channel.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Newest poses of all participants. Messages are decoded on access: the scene has priority.</summary>
    public sealed class PresenceTable
    {
        /// <summary>Messages that may wait to be decoded.</summary>
        private const int MaxWaiting = 8;

        /// <summary>Devices of all participants: more than a session has.</summary>
        private const int MaxItems = 1024;

        private readonly StateCounters counters;
        private readonly WireReader reader = new WireReader();
        private readonly Presence read = new Presence();

        // Copies of messages that wait; buffers are used again.
        private readonly byte[][] waiting = new byte[MaxWaiting][];
        private readonly int[] lengths = new int[MaxWaiting];
        private readonly List<PresenceItem> items = new List<PresenceItem>();
        private int waitingCount;
        private long presenceNs;
        private long taken;

        internal PresenceTable(StateCounters counters)
        {
            this.counters = counters;
        }

        /// <summary>Session time of the newest presence [ns].</summary>
        public long SessionTimeNs { get { return presenceNs; } }

        /// <summary>Return the newest item of every device of every participant, poses in the world frame. The next message overwrites them.</summary>
        public IReadOnlyList<PresenceItem> ListItems()
        {
            DecodeWaiting();
            return items;
        }

        /// <summary>Return whether presence has come since the last call.</summary>
        public bool TakeNews()
        {
            long before = taken;
            DecodeWaiting();
            taken = counters.Presence;
            return taken != before;
        }

        internal void Reset()
        {
            items.Clear();
            waitingCount = 0;
            presenceNs = 0;
        }

        /// <summary>Keep a copy of a message.</summary>
        internal void Add(byte[] bytes, int offset, int count)
        {
            if (waitingCount == MaxWaiting) DecodeWaiting();
            if (waiting[waitingCount] == null || waiting[waitingCount].Length < count) waiting[waitingCount] = new byte[Math.Max(count, 1024)];
            Buffer.BlockCopy(bytes, offset, waiting[waitingCount], 0, count);
            lengths[waitingCount++] = count;
        }

        /// <summary>Remove all participants that are not connected: presence that they sent before leaving may arrive late.</summary>
        internal void Retain(SessionMirror mirror)
        {
            DecodeWaiting();
            for (int i = items.Count - 1; i >= 0; i--)
            {
                if (!mirror.Participants.TryGetValue(items[i].Participant, out ParticipantInfo info) || !info.Connected) items.RemoveAt(i);
            }
        }

        /// <summary>Remove a participant that left.</summary>
        internal void Remove(string participant)
        {
            DecodeWaiting();
            for (int i = items.Count - 1; i >= 0; i--) if (items[i].Participant == participant) items.RemoveAt(i);
        }

        private void DecodeWaiting()
        {
            for (int i = 0; i < waitingCount; i++)
            {
                try
                {
                    reader.Reset(waiting[i], 0, lengths[i]);
                    reader.ReadInto(read);
                    reader.ExpectEnd();
                    TakeItems();
                }
                catch (WireException)
                {
                    counters.Malformed++;
                }
            }
            waitingCount = 0;
        }

        private void TakeItems()
        {
            if (read.SessionTime < presenceNs)
            {
                counters.OutOfOrder++;
                return;
            }
            counters.Presence++;
            presenceNs = read.SessionTime;
            foreach (PresenceItem item in read.Items)
            {
                int at = 0;
                while (at < items.Count && !(items[at].Device == item.Device && items[at].Participant == item.Participant)) at++;
                if (at == MaxItems) continue;
                if (at == items.Count) items.Add(new PresenceItem { Participant = item.Participant, Device = item.Device });
                PresenceItem kept = items[at];
                kept.CaptureNs = item.CaptureNs;
                Array.Copy(item.Pose.P, kept.Pose.P, 3);
                Array.Copy(item.Pose.Q, kept.Pose.Q, 4);
            }
        }
    }
}
