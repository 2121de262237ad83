// Frames of a WebSocket to messages (RFC 6455, sections 5 and 7), for a client. Pure: bytes in, events out.
//
// Refused: masked frames, reserved bits and opcodes, fragments out of order, control frames that are long or in fragments, text, and
// messages above the limit. Buffers grow with the bytes that came, not with the length that a head states.
using System;
using System.Text;

namespace IrisSession.Transport
{
    /// <summary>What <see cref="WebSocketReader.Read"/> found.</summary>
    internal enum WebSocketEvent
    {
        /// <summary>All bytes are used up.</summary>
        NeedsMore,

        /// <summary>`Message` holds a binary message.</summary>
        Message,

        /// <summary>`Control` holds what a pong has to repeat.</summary>
        Ping,
        Pong,

        /// <summary>The other end closes: `CloseCode`, `CloseReason`.</summary>
        Close,
    }

    /// <summary>Reads the frames of one connection. Made once per connection; its buffers are used again for every message.</summary>
    internal sealed class WebSocketReader
    {
        /// <summary>Close codes of RFC 6455, section 7.4.1.</summary>
        public const int ProtocolError = 1002;
        public const int NoText = 1003;
        public const int TooLarge = 1009;
        private const int NoCode = 1005;

        private const int MaxControlBytes = 125;
        private const int FirstBytes = 4096;
        private const int Continuation = 0;
        private const int Text = 1;
        private const int Binary = 2;
        private const int CloseFrame = 8;
        private const int PingFrame = 9;
        private const int PongFrame = 10;

        private readonly int maxBytes;
        private readonly byte[] head = new byte[10];
        private byte[] message = new byte[FirstBytes];
        private int headLength;
        private int opcode = -1; // of the frame in progress, -1 between frames
        private bool isFinal;
        private bool isInMessage;
        private long left; // bytes of the frame in progress that are to come

        /// <param name="maxBytes">Most bytes of a message.</param>
        public WebSocketReader(int maxBytes)
        {
            this.maxBytes = maxBytes;
        }

        /// <summary>The newest message, of which `MessageLength` bytes count. Overwritten by the next one.</summary>
        public byte[] Message { get { return message; } }

        public int MessageLength { get; private set; }

        /// <summary>Content of the newest ping or close, of which `ControlLength` bytes count.</summary>
        public readonly byte[] Control = new byte[MaxControlBytes];

        public int ControlLength { get; private set; }

        public int CloseCode { get; private set; }

        public string CloseReason { get; private set; } = "";

        /// <summary>Exchange the buffer of the newest message for another one.</summary>
        public byte[] TakeMessage(byte[] other)
        {
            byte[] taken = message;
            message = other.Length >= FirstBytes ? other : new byte[FirstBytes];
            return taken;
        }

        /// <summary>Process bytes from `at` on until something is complete; `at` is moved behind what was used.</summary>
        /// <exception cref="TransportException">The bytes break the rules; `Code` is that of the close frame to send.</exception>
        public WebSocketEvent Read(byte[] bytes, ref int at, int end)
        {
            while (true)
            {
                if (opcode < 0)
                {
                    if (!ReadHead(bytes, ref at, end)) return WebSocketEvent.NeedsMore;
                    BeginFrame();
                }
                int some = (int)Math.Min(left, end - at);
                if (some > 0)
                {
                    Append(bytes, at, some);
                    at += some;
                    left -= some;
                }
                if (left > 0) return WebSocketEvent.NeedsMore;
                int ended = opcode;
                opcode = -1;
                if (ended >= CloseFrame) return EndControl(ended);
                if (!isFinal) continue;
                isInMessage = false;
                return WebSocketEvent.Message;
            }
        }

        private static int LongLength(int length)
        {
            return length == 126 ? 2 : length == 127 ? 8 : 0;
        }

        /// <summary>Read the head of a frame. False: more bytes are needed.</summary>
        private bool ReadHead(byte[] bytes, ref int at, int end)
        {
            while (headLength < 2 || headLength < 2 + LongLength(head[1] & 0x7f))
            {
                if (at == end) return false;
                head[headLength++] = bytes[at++];
            }
            return true;
        }

        private void BeginFrame()
        {
            int first = head[0];
            int size = 2 + LongLength(head[1] & 0x7f);
            left = head[1] & 0x7f;
            if (size > 2)
            {
                ulong length = 0;
                for (int i = 2; i < size; i++) length = length << 8 | head[i];
                if (length > int.MaxValue) throw Refuse(TooLarge, "a frame of " + length + " bytes");
                left = (long)length;
            }
            headLength = 0;
            isFinal = (first & 0x80) != 0;
            opcode = first & 0x0f;
            if ((first & 0x70) != 0) throw Refuse(ProtocolError, "a frame with reserved bits");
            if ((head[1] & 0x80) != 0) throw Refuse(ProtocolError, "a masked frame from a server");
            if (opcode >= CloseFrame) BeginControl();
            else BeginData();
        }

        private void BeginControl()
        {
            if (opcode > PongFrame) throw Refuse(ProtocolError, "a frame of unknown opcode " + opcode);
            if (!isFinal || left > MaxControlBytes) throw Refuse(ProtocolError, "a control frame of " + left + " bytes, or in fragments");
            ControlLength = 0;
        }

        private void BeginData()
        {
            if (opcode == Text) throw Refuse(NoText, "a text message");
            if (opcode > Binary) throw Refuse(ProtocolError, "a frame of unknown opcode " + opcode);
            if (opcode == Continuation != isInMessage) throw Refuse(ProtocolError, "a fragment out of order");
            if (!isInMessage) MessageLength = 0;
            isInMessage = true;
            if (left > maxBytes - MessageLength) throw Refuse(TooLarge, "a message of more than " + maxBytes + " bytes");
        }

        private void Append(byte[] bytes, int at, int count)
        {
            if (opcode >= CloseFrame)
            {
                Buffer.BlockCopy(bytes, at, Control, ControlLength, count);
                ControlLength += count;
                return;
            }
            int needed = MessageLength + count;
            if (needed > message.Length) Array.Resize(ref message, (int)Math.Min(Math.Max(needed, 2L * message.Length), maxBytes));
            Buffer.BlockCopy(bytes, at, message, MessageLength, count);
            MessageLength = needed;
        }

        private WebSocketEvent EndControl(int ended)
        {
            if (ended == PingFrame) return WebSocketEvent.Ping;
            if (ended == PongFrame) return WebSocketEvent.Pong;
            if (ControlLength == 1) throw Refuse(ProtocolError, "a close frame of one byte");
            CloseCode = ControlLength == 0 ? NoCode : Control[0] << 8 | Control[1];
            CloseReason = ControlLength <= 2 ? "" : Encoding.UTF8.GetString(Control, 2, ControlLength - 2); // bad bytes become U+FFFD
            return WebSocketEvent.Close;
        }

        private static TransportException Refuse(int code, string what)
        {
            return new TransportException(LinkFailure.Protocol, "the gateway sent " + what, code);
        }
    }
}
