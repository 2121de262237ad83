// Frames of a WebSocket that a client sends (RFC 6455, section 5.2): whole and masked. Pure.
using System;
using System.Security.Cryptography;

namespace IrisSession.Transport
{
    /// <summary>Appends frames to one buffer, which is used again. For one thread at a time.</summary>
    internal sealed class WebSocketWriter
    {
        private const int Binary = 0x82;
        private const int CloseFrame = 0x88;
        private const int PongFrame = 0x8a;
        private const int MaskBytes = 4;

        private readonly byte[] masks = new byte[1024]; // random bytes, used from the end
        private readonly RandomNumberGenerator random = RandomNumberGenerator.Create();
        private int masksLeft;
        private byte[] data = new byte[4096];

        /// <summary>Frames that were appended, of which `Length` bytes count.</summary>
        public byte[] Data { get { return data; } }

        public int Length { get; private set; }

        public void Clear()
        {
            Length = 0;
        }

        /// <summary>Exchange the buffer of appended frames for an empty one.</summary>
        public byte[] Take(byte[] other)
        {
            byte[] taken = data;
            data = other;
            Length = 0;
            return taken;
        }

        /// <summary>Append a binary message that holds one frame of a channel.</summary>
        public void AppendMessage(int channel, byte[] bytes, int count)
        {
            int at = Begin(Binary, WebMessage.HeadBytes + count);
            data[at] = (byte)channel;
            data[at + 1] = 1;
            for (int i = 0; i < 4; i++) data[at + 2 + i] = (byte)(count >> 8 * i);
            Buffer.BlockCopy(bytes, 0, data, at + WebMessage.HeadBytes, count);
            End(at, WebMessage.HeadBytes + count);
        }

        /// <summary>Append the answer to a ping.</summary>
        public void AppendPong(byte[] content, int count)
        {
            int at = Begin(PongFrame, count);
            Buffer.BlockCopy(content, 0, data, at, count);
            End(at, count);
        }

        /// <summary>Append a close frame without a reason.</summary>
        public void AppendClose(int code)
        {
            int at = Begin(CloseFrame, 2);
            data[at] = (byte)(code >> 8);
            data[at + 1] = (byte)code;
            End(at, 2);
        }

        /// <summary>Write the head of a frame with a fresh mask. Returns where its payload begins.</summary>
        private int Begin(int first, int count)
        {
            int needed = Length + 10 + MaskBytes + count;
            if (needed > data.Length) Array.Resize(ref data, Math.Max(needed, 2 * data.Length));
            int at = Length;
            data[at++] = (byte)first;
            if (count < 126) data[at++] = (byte)(0x80 | count);
            else if (count < 1 << 16)
            {
                data[at++] = 0x80 | 126;
                data[at++] = (byte)(count >> 8);
                data[at++] = (byte)count;
            }
            else
            {
                data[at++] = 0x80 | 127;
                for (int i = 7; i >= 0; i--) data[at++] = (byte)((long)count >> 8 * i);
            }
            if (masksLeft == 0)
            {
                random.GetBytes(masks);
                masksLeft = masks.Length;
            }
            masksLeft -= MaskBytes;
            Buffer.BlockCopy(masks, masksLeft, data, at, MaskBytes);
            return at + MaskBytes;
        }

        private void End(int at, int count)
        {
            for (int i = 0; i < count; i++) data[at + i] ^= data[at - MaskBytes + (i & 3)];
            Length = at + count;
        }
    }
}
