// State channel of a client: from frames to the newest scene. Pure: bytes and times are passed in.
//
// Bounded staleness: the caller passes all messages that came together; only the newest rigid frame is decoded. After a silence (this
// client or its link stood still) frames have waited in queues: they are dropped until a fresh one comes, so the first frame handed
// out is fresh. On a link where every frame is old, the newest one counts as fresh.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Counters of state frames. Every frame that came is either `Delivered` or counted in exactly one other field.</summary>
    public sealed class StateCounters
    {
        public long Delivered;
        public long Superseded;
        public long QueuedOld;
        public long OutOfOrder;
        public long BeforeSnapshot;
        public long OtherEpoch;
        public long Undecodable;
        public long Malformed;
        public long UnknownTopic;
        public long BytesReceived;
        public long Presence;
    }

    /// <summary>Decoder of the newest frame of each drain. Allocates nothing for frames of the same scene.</summary>
    public sealed class StateStream
    {
        /// <summary>No frame for this long: the next frames may have waited in queues.</summary>
        private const long StalledNs = 50_000_000;

        /// <summary>A frame published this long ago waited in a queue ...</summary>
        private const long QueuedNs = 60_000_000;

        /// <summary>... but after this long without a fresher one it is the newest there is (slow link).</summary>
        private const long FlushNs = 150_000_000;

        /// <summary>Frames over which the usual age of frames on this link is averaged.</summary>
        private const int Usual = 8;

        public readonly StateCounters Counters = new StateCounters();
        public readonly PresenceTable Presence;
        private readonly byte[] topicRigid = Encoding.ASCII.GetBytes(Wire.TopicRigid);
        private readonly byte[] topicPresence = Encoding.ASCII.GetBytes(Wire.TopicPresence);
        private readonly WireReader reader = new WireReader();

        // Read into `scratch`; the newest of a drain is in `newest`; the one that was handed out in `Header`. They are exchanged.
        private StateHeader scratch = new StateHeader();
        private StateHeader newest = new StateHeader();
        private RigidDecoder decoder;
        private long cameNs = -1;
        private long flushUntil;
        private long usualAge;

        public StateStream()
        {
            Presence = new PresenceTable(Counters);
        }

        /// <summary>
        /// The newest epoch whose bodies the application knows, by events or snapshot. Frames of other epochs are decoded and counted, but
        /// not handed out, because their bodies may differ.
        /// </summary>
        public long SceneEpoch { get; internal set; }

        /// <summary>True when the deltas have lost their base.</summary>
        public bool WantsSnapshot { get; private set; }

        /// <summary>Header of the newest state that was handed out. Overwritten by the next one.</summary>
        public StateHeader Header { get; private set; } = new StateHeader();

        /// <summary>Rows `x y z qw qx qy qz` in the order of `SessionMirror.Bodies`, world frame; null before the first snapshot.</summary>
        public double[] Poses { get { return decoder == null ? null : decoder.Poses; } }

        /// <summary>Session time at which the newest state was handed out [ns].</summary>
        public long ReceivedNs { get; private set; }

        /// <summary>Age of the newest state when it was handed out, from the end of its tick [ns].</summary>
        public long AgeNs { get; private set; }

        /// <summary>Process all received messages, oldest first. Returns whether there is a new state.</summary>
        /// <param name="messages">Frames of the state channel: topic, then those of the topic.</param>
        /// <param name="nowNs">Session time [ns].</param>
        /// <param name="localNs">The client's monotonic clock [ns].</param>
        public bool Drain(IReadOnlyList<Multipart> messages, long nowNs, long localNs)
        {
            Multipart rigid = null;
            for (int i = 0; i < messages.Count; i++)
            {
                Multipart message = messages[i];
                Counters.BytesReceived += message.TotalBytes;
                bool isRigid = HasTopic(message, topicRigid);
                if (isRigid && message.Count == 3)
                {
                    if (!TryReadHeader(message)) continue;
                    if (rigid != null) Counters.Superseded++;
                    rigid = message;
                    StateHeader before = newest;
                    newest = scratch;
                    scratch = before;
                }
                else if (!isRigid && HasTopic(message, topicPresence))
                {
                    if (message.Count == 2) Presence.Add(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                    else Counters.Malformed++;
                }
                else if (isRigid) Counters.Malformed++;
                else Counters.UnknownTopic++;
            }
            return rigid != null && Decode(rigid, nowNs, localNs);
        }

        /// <summary>Clear all frames for another session: its frames may be numbered from the beginning.</summary>
        internal void Reset()
        {
            decoder = null;
            Presence.Reset();
            WantsSnapshot = false;
            Restart();
        }

        /// <summary>Prepare for frames by another route: its queues are still empty, and the usual age may differ.</summary>
        internal void Restart()
        {
            cameNs = -1;
            flushUntil = 0;
            usualAge = 0;
        }

        /// <summary>Take the poses of a snapshot, the bytes of its bulk frame; poses of newer frames are kept.</summary>
        /// <exception cref="DecodeException">Its size is not that of the bodies.</exception>
        internal void LoadKeyframe(long stateSeq, int bodyCount, byte[] bulk, int offset, int count)
        {
            if (count != 56 * (long)bodyCount) throw new DecodeException("keyframe of " + count + " bytes for " + bodyCount + " bodies");
            if (decoder == null || decoder.BodyCount != bodyCount) decoder = new RigidDecoder(bodyCount);
            decoder.LoadKeyframe(stateSeq, bulk, offset, count);
            WantsSnapshot = false;
        }

        private static bool HasTopic(Multipart message, byte[] topic)
        {
            if (message.Count == 0 || message.LengthOf(0) != topic.Length) return false;
            for (int i = 0; i < topic.Length; i++) if (message.Buffer[message.OffsetOf(0) + i] != topic[i]) return false;
            return true;
        }

        private bool TryReadHeader(Multipart message)
        {
            try
            {
                reader.Reset(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                reader.ReadInto(scratch);
                reader.ExpectEnd();
                return true;
            }
            catch (WireException)
            {
                Counters.Malformed++;
                return false;
            }
        }

        private bool Decode(Multipart message, long nowNs, long localNs)
        {
            StateHeader header = newest;
            if (IsFromQueue(nowNs - header.PublishedNs, localNs))
            {
                Counters.QueuedOld++;
                return false;
            }
            if (decoder == null)
            {
                Counters.BeforeSnapshot++;
                return false;
            }
            if (header.StateSeq <= decoder.StateSeq)
            {
                Counters.OutOfOrder++;
                return false;
            }
            bool isComplete;
            try
            {
                isComplete = decoder.Apply(header.StateSeq, header.BaseSeq, message.Buffer, message.OffsetOf(2), message.LengthOf(2));
            }
            catch (DecodeException)
            {
                Counters.Malformed++;
                WantsSnapshot = true; // perhaps the bodies changed
                return false;
            }
            if (header.SceneEpoch != SceneEpoch)
            {
                Counters.OtherEpoch++;
                return false;
            }
            if (!isComplete)
            {
                Counters.Undecodable++;
                WantsSnapshot = true;
                return false;
            }
            Counters.Delivered++;
            newest = Header;
            Header = header;
            ReceivedNs = nowNs;
            AgeNs = nowNs - header.SessionTime;
            return true;
        }

        /// <summary>Return whether a frame that comes now is to be dropped, because fresher ones must be right behind it.</summary>
        private bool IsFromQueue(long ageNs, long localNs)
        {
            bool stoodStill = cameNs >= 0 && localNs - cameNs > StalledNs;
            cameNs = localNs;
            bool old = ageNs > Math.Max(QueuedNs, 2 * usualAge);
            if (old && stoodStill && flushUntil == 0) flushUntil = localNs + FlushNs;
            if (old && localNs < flushUntil) return true;
            // No fresher frame came in time, so this is the usual age of frames on this link from now on.
            int weight = (old && flushUntil > 0) || usualAge == 0 ? 1 : Usual;
            long change = ageNs - usualAge;
            usualAge += change >= 0 ? change / weight : -((-change + weight - 1) / weight);
            flushUntil = 0;
            return false;
        }
    }
}
