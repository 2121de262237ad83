using System;

namespace IrisSession.Core
{
    /// <summary>A message of several frames (docs/protocol.md, section 2), views into one buffer. Made once and filled again.</summary>
    public sealed class Multipart
    {
        /// <summary>Frames of the longest message.</summary>
        public const int MaxFrames = 4;

        private readonly int[] offsets = new int[MaxFrames];
        private readonly int[] lengths = new int[MaxFrames];

        /// <summary>The bytes of all frames. May be exchanged when the message is filled again.</summary>
        public byte[] Buffer = new byte[0];

        /// <summary>Number of frames.</summary>
        public int Count { get; private set; }

        public int OffsetOf(int frame)
        {
            return offsets[frame];
        }

        public int LengthOf(int frame)
        {
            return lengths[frame];
        }

        /// <summary>Bytes of all frames together.</summary>
        public long TotalBytes
        {
            get
            {
                long total = 0;
                for (int i = 0; i < Count; i++) total += lengths[i];
                return total;
            }
        }

        public void Clear()
        {
            Count = 0;
        }

        /// <summary>Add a frame at `Buffer[offset]`. False when there are too many.</summary>
        public bool Add(int offset, int length)
        {
            if (offset < 0 || length < 0 || offset > Buffer.Length - length) throw new ArgumentOutOfRangeException(nameof(length));
            if (Count == MaxFrames) return false;
            offsets[Count] = offset;
            lengths[Count++] = length;
            return true;
        }
    }
}
