using System;

namespace IrisSession.Core
{
    /// <summary>Bytes that do not fit their format. Decoders of the core throw nothing else, whatever the bytes are.</summary>
    public sealed class DecodeException : Exception
    {
        public DecodeException(string message) : base(message)
        {
        }

        public DecodeException(string message, Exception cause) : base(message, cause)
        {
        }
    }
}
