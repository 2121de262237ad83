// Binary messages of a gateway's WebSockets: channel u8, count u8, `count` lengths u32 little-endian, then the frames, which are those
// of ZeroMQ. docs/protocol.md, web channel, is normative.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>Takes messages apart, and puts those together that are no envelopes.</summary>
    internal static class WebMessage
    {
        public const int Control = 1;
        public const int State = 2;
        public const int Media = 3;
        public const int Wishes = 4;
        public const int Gateway = 5;

        /// <summary>Subprotocol of both WebSockets.</summary>
        public const string Subprotocol = "iris-session.1";

        /// <summary>Bytes before the frame of a message that has one.</summary>
        public const int HeadBytes = 6;

        /// <summary>Set the frames of `message` to those of a message in its buffer. Returns the channel; -1: it is malformed.</summary>
        public static int Unpack(Multipart message, int length)
        {
            byte[] bytes = message.Buffer;
            message.Clear();
            if (length < 2) return -1;
            int count = bytes[1];
            long at = 2 + 4L * count;
            if (count == 0 || count > Multipart.MaxFrames || at > length) return -1;
            for (int i = 0; i < count; i++)
            {
                int from = 2 + 4 * i;
                uint size = (uint)(bytes[from] | bytes[from + 1] << 8 | bytes[from + 2] << 16 | bytes[from + 3] << 24);
                if (size > length - at) return -1;
                message.Add((int)at, (int)size);
                at += size;
            }
            return at == length ? bytes[0] : -1;
        }

        /// <summary>Return the frame of a ticket, the first message of /v1/media.</summary>
        public static byte[] EncodeTicket(string ticket)
        {
            WireWriter writer = new WireWriter();
            writer.WriteMapHeader(2);
            writer.Write("type");
            writer.Write("ticket");
            writer.Write("ticket");
            writer.Write(ticket);
            return writer.ToArray();
        }

        /// <summary>Return the frame that names all wanted streams.</summary>
        public static byte[] EncodeWishes(IReadOnlyList<string> streams)
        {
            WireWriter writer = new WireWriter();
            writer.WriteArrayHeader(streams.Count);
            foreach (string stream in streams) writer.Write(stream);
            return writer.ToArray();
        }

        /// <summary>Read a message of the gateway itself. False: it is malformed. Those of unknown types have neither ticket nor notice.</summary>
        public static bool TryReadGateway(Multipart message, out string ticket, out string notice)
        {
            ticket = notice = null;
            string type = null;
            string text = null;
            string given = null;
            try
            {
                WireReader reader = new WireReader();
                reader.Reset(message.Buffer, message.OffsetOf(0), message.LengthOf(0));
                for (int left = reader.ReadMapHeader(); left > 0; left--)
                {
                    string key = reader.ReadString();
                    if (key == "type") type = reader.ReadString();
                    else if (key == "ticket") given = reader.ReadString();
                    else if (key == "text") text = reader.ReadString();
                    else reader.Skip();
                }
                reader.ExpectEnd();
            }
            catch (WireException)
            {
                return false;
            }
            if (type == "ticket") ticket = given;
            if (type == "notice") notice = text;
            return type != null && (type != "ticket" || given != null) && (type != "notice" || text != null);
        }
    }
}
