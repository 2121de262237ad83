// Media frames of one session: vertices of deformables and point clouds, each decoded as it comes. Pictures are left to others.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Counters of media frames. Every frame that came is either `Decoded` or counted in exactly one other field.</summary>
    public sealed class MediaCounters
    {
        public long Decoded;
        public long OutOfOrder;
        public long Malformed;

        /// <summary>Frames of deformables that the scene does not have, or whose topology is not here yet; pictures.</summary>
        public long Unused;

        /// <summary>Frames of streams beyond the most that a session has.</summary>
        public long TooMany;
    }

    /// <summary>One deformable as it is shown.</summary>
    public sealed class DeformableStream
    {
        public readonly DeformableDecoder Decoder;
        public readonly VertexBuffer Buffer = new VertexBuffer();
        internal long SceneEpoch = -1;
        internal long Seq = -1;

        internal DeformableStream(DeformableDecoder decoder)
        {
            Decoder = decoder;
        }
    }

    /// <summary>One point cloud: its newest frame.</summary>
    public sealed class CloudStream
    {
        public readonly string Name;
        public readonly Cloud Cloud = new Cloud();
        internal long Seq = -1;

        internal CloudStream(string name)
        {
            Name = name;
        }

        /// <summary>Counts frames: another number is another cloud.</summary>
        public long Version { get; internal set; }

        /// <summary>Session time of the newest frame [ns].</summary>
        public long CaptureNs { get; internal set; }
    }

    /// <summary>Decodes media frames. Allocates nothing for streams that are known. For one thread.</summary>
    public sealed class MediaStreams
    {
        /// <summary>Streams of a session, docs/protocol.md.</summary>
        public const int MaxStreams = 16;
        public readonly MediaCounters Counters = new MediaCounters();
        private readonly Dictionary<string, DeformableStream> deformables = new Dictionary<string, DeformableStream>();
        private readonly List<CloudStream> clouds = new List<CloudStream>();
        private readonly WireReader reader = new WireReader();
        private readonly MediaHeader header = new MediaHeader();

        public IReadOnlyList<CloudStream> Clouds { get { return clouds; } }

        /// <summary>Show a deformable: its frames are decoded from now on. Returns what is shown of it.</summary>
        public DeformableStream AddDeformable(string stream, DeformableDecoder decoder)
        {
            return deformables[stream] = new DeformableStream(decoder);
        }

        public void RemoveDeformable(string stream) { deformables.Remove(stream); }

        /// <summary>Remove clouds whose streams the session does not have any more.</summary>
        public void Retain(DeliveryBudget budget)
        {
            for (int i = clouds.Count - 1; i >= 0; i--)
            {
                bool isKnown = false;
                foreach (StreamBudget one in budget.Streams) isKnown |= one.Stream == clouds[i].Name;
                if (!isKnown) clouds.RemoveAt(i);
            }
        }

        /// <summary>Process a message of the media channel: topic, header, bytes.</summary>
        public void Process(Multipart message)
        {
            try
            {
                if (message.Count != 3) throw new DecodeException("a media message of " + message.Count + " frames");
                reader.Reset(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                reader.ReadInto(header);
                reader.ExpectEnd();
                if (header.Encoding == MediaEncoding.Deformable) TakeDeformable(message);
                else if (header.Encoding == MediaEncoding.Cloud) TakeCloud(message);
                else Counters.Unused++;
            }
            catch (WireException)
            {
                Counters.Malformed++;
            }
            catch (DecodeException)
            {
                Counters.Malformed++;
            }
        }

        private void TakeDeformable(Multipart message)
        {
            if (!deformables.TryGetValue(header.Stream, out DeformableStream stream))
            {
                Counters.Unused++;
                return;
            }
            if (header.Seq <= stream.Seq && header.SceneEpoch == stream.SceneEpoch)
            {
                Counters.OutOfOrder++;
                return;
            }
            stream.Decoder.Decode(message.Buffer, message.OffsetOf(2), message.LengthOf(2));
            if (header.SceneEpoch != stream.SceneEpoch) stream.Buffer.Clear(); // across a jump nothing is interpolated
            stream.SceneEpoch = header.SceneEpoch;
            stream.Seq = header.Seq;
            stream.Buffer.Add(header.CaptureNs, stream.Decoder.Positions);
            Counters.Decoded++;
        }

        private void TakeCloud(Multipart message)
        {
            CloudStream stream = null;
            foreach (CloudStream one in clouds) if (one.Name == header.Stream) stream = one;
            if (stream == null && clouds.Count == MaxStreams)
            {
                Counters.TooMany++;
                return;
            }
            if (stream != null && header.Seq <= stream.Seq && header.CaptureNs <= stream.CaptureNs) // a source that starts again counts from 0
            {
                Counters.OutOfOrder++;
                return;
            }
            if (stream == null) stream = new CloudStream(header.Stream);
            stream.Cloud.Decode(message.Buffer, message.OffsetOf(2), message.LengthOf(2));
            if (stream.Version == 0) clouds.Add(stream);
            stream.Seq = header.Seq;
            stream.CaptureNs = header.CaptureNs;
            stream.Version++;
            Counters.Decoded++;
        }
    }
}
