// Envelopes of the control channel, and what the core needs of messages whatever their type is.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Encodes and decodes messages with one buffer. For one thread.</summary>
    internal sealed class MessageCodec
    {
        private readonly WireReader reader = new WireReader();
        private readonly WireWriter writer = new WireWriter();
        private readonly ClientEnvelope envelope = new ClientEnvelope { Version = Wire.Version };

        /// <summary>Bytes of the last <see cref="Encode"/>, of which <see cref="Length"/> count.</summary>
        public byte[] Bytes { get { return writer.Data; } }

        public int Length { get { return writer.Length; } }

        /// <summary>Encode an envelope to <see cref="Bytes"/>.</summary>
        public void Encode(ClientMessage message, long connectionEpoch)
        {
            writer.Clear();
            envelope.ConnectionEpoch = connectionEpoch;
            envelope.Message = message;
            envelope.WriteTo(writer);
        }

        /// <summary>Return the message of an envelope.</summary>
        /// <exception cref="WireException">It is none of this version.</exception>
        public ServerMessage DecodeServer(byte[] bytes, int offset, int count, out long connectionEpoch)
        {
            reader.Reset(bytes, offset, count);
            ServerEnvelope read = ServerEnvelope.Read(reader);
            reader.ExpectEnd();
            if (read.Version != Wire.Version) throw new WireException("protocol version " + read.Version + ": version " + Wire.Version + " is spoken here");
            connectionEpoch = read.ConnectionEpoch;
            return read.Message;
        }

        public static Lease Copy(Lease value) { return Lease.Read(new WireReader(value.Encode())); }

        public static ParticipantInfo Copy(ParticipantInfo value) { return ParticipantInfo.Read(new WireReader(value.Encode())); }

        public static AnchorInfo Copy(AnchorInfo value) { return AnchorInfo.Read(new WireReader(value.Encode())); }

        /// <summary>Return a hello with another secret and token; the rest is shared.</summary>
        public static Hello WithIdentity(Hello hello, byte[] secret, byte[] resumeToken)
        {
            Hello copy = Hello.Read(new WireReader(hello.Encode()));
            copy.Secret = secret;
            copy.ResumeToken = resumeToken;
            return copy;
        }
    }
}
