// Ends of connections to a gateway: what a person or the session loop has to know of them.
//
//     TransportException     a connection could not be made, or broke; never leaves the threads of the transport
using System;

namespace IrisSession.Transport
{
    /// <summary>Reason for which a connection is not there, or not any more.</summary>
    public enum LinkFailure
    {
        /// <summary>None: it is open, or we closed it.</summary>
        None,

        /// <summary>No answer: no such host, connection refused or lost, timeout.</summary>
        Unreachable,

        /// <summary>The other end closed it; `Code` says why.</summary>
        Closed,

        /// <summary>The certificate is not known yet: show <see cref="LinkEnd.Fingerprint"/> to the person. Nothing was sent.</summary>
        UnknownCertificate,

        /// <summary>The certificate has another key than the pinned one: another machine, or one that pretends to be it. Nothing was sent.</summary>
        WrongCertificate,

        /// <summary>The other end is no gateway of this protocol: TLS or HTTP fails, or it answers with another status (`Code`).</summary>
        NotAGateway,

        /// <summary>The other end broke the rules of WebSocket or HTTP.</summary>
        Protocol,

        /// <summary>We do not read fast enough: the queue of control messages is full.</summary>
        Overflow,

        /// <summary>A defect of this program has ended the session: it has to be started again.</summary>
        Defect,
    }

    /// <summary>How a connection ended.</summary>
    public readonly struct LinkEnd
    {
        public readonly LinkFailure Failure;

        /// <summary>Close code of the WebSocket, or HTTP status; 0 for none.</summary>
        public readonly int Code;

        /// <summary>Words for people, in English; may be empty.</summary>
        public readonly string Text;

        /// <summary>SHA-256 of the public key that the other end showed, null for none.</summary>
        public readonly byte[] CertificateHash;

        /// <summary>Fingerprint of the certificate, for people to compare with that of `iris-session pair`: `3F:A2:...`; empty for none.</summary>
        public readonly string Fingerprint;

        public LinkEnd(LinkFailure failure, int code, string text, byte[] certificateHash = null, string fingerprint = "")
        {
            Failure = failure;
            Code = code;
            Text = text;
            CertificateHash = certificateHash;
            Fingerprint = fingerprint;
        }

        public override string ToString()
        {
            return Failure + (Code == 0 ? "" : " " + Code) + (string.IsNullOrEmpty(Text) ? "" : ": " + Text);
        }
    }

    /// <summary>Close codes of a gateway (docs/protocol.md, web channel).</summary>
    public static class CloseCode
    {
        public const int SessionEnded = 4000;
        public const int Version = 4001;
        public const int NotAllowed = 4003;
        public const int TooSlow = 4008;
        public const int Flood = 4009;
        public const int Restart = 1012;
    }

    /// <summary>A connection could not be made, or broke.</summary>
    internal sealed class TransportException : Exception
    {
        public readonly LinkEnd End;

        public TransportException(LinkFailure failure, string text, int code = 0, byte[] certificateHash = null, string fingerprint = "") : base(text)
        {
            End = new LinkEnd(failure, code, text, certificateHash, fingerprint);
        }
    }
}
