// Errors of the application's calls. What a session sends never throws.
//
//     ClientException               what the application did cannot be done
//     +-- NotConnectedException     no connection to a session now
//     +-- InvalidMessageException   a value does not fit the protocol; nothing was sent
using System;

namespace IrisSession.Core
{
    /// <summary>Base of the errors of the application's calls.</summary>
    public abstract class ClientException : Exception
    {
        protected ClientException(string message) : base(message)
        {
        }
    }

    /// <summary>There is no connection to a session. The message says why, for people.</summary>
    public sealed class NotConnectedException : ClientException
    {
        public NotConnectedException(string message) : base(message)
        {
        }
    }

    /// <summary>A message that does not fit the protocol. Nothing was sent.</summary>
    public sealed class InvalidMessageException : ClientException
    {
        public InvalidMessageException(string message) : base(message)
        {
        }
    }
}
