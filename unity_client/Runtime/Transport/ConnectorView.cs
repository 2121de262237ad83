using System;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>How far a <see cref="SessionConnector"/> is.</summary>
    public enum ConnectorPhase
    {
        /// <summary>Not started, or stopped.</summary>
        Idle,

        /// <summary>It looks for the session, or joins it. `Phrase` says why that takes long.</summary>
        Searching,

        /// <summary>Several sessions announce themselves: <see cref="SessionConnector.Choose"/>.</summary>
        Choosing,

        /// <summary>It pairs with a session by a join code.</summary>
        Pairing,

        /// <summary>The key of the session is not known, and nothing was sent: <see cref="SessionConnector.Trust"/> or <see cref="SessionConnector.EnterCode"/>.</summary>
        Untrusted,

        /// <summary>The session was joined. Losses of the connection are mended by the client.</summary>
        Running,

        /// <summary>It does not go on by itself: `Phrase` says why, and what to do. <see cref="SessionConnector.Retry"/>, <see cref="SessionConnector.Enter"/>.</summary>
        Failed,
    }

    /// <summary>A session that announces itself. Immutable.</summary>
    public sealed class OfferedSession
    {
        public readonly string Name;
        public readonly string Host;

        /// <summary>Of its gateway.</summary>
        public readonly int Port;

        /// <summary>True when its key is known: it was paired with, or trusted, before.</summary>
        public readonly bool IsKnown;
        internal readonly string Id;

        internal OfferedSession(string id, string name, string host, int port, bool isKnown)
        {
            Id = id;
            Name = name;
            Host = host;
            Port = port;
            IsKnown = isKnown;
        }
    }

    /// <summary>What a <see cref="SessionConnector"/> does, for a panel. Never changes: another one replaces it.</summary>
    public sealed class ConnectorView
    {
        public readonly ConnectorPhase Phase;

        /// <summary>What is wrong and what to do; empty while all goes well.</summary>
        public readonly Phrase Phrase;

        /// <summary>Sessions to choose from, by name.</summary>
        public readonly OfferedSession[] Sessions;

        /// <summary>Fingerprint of the certificate of a session that is not known, to be compared with that of `iris-session pair`; else empty.</summary>
        public readonly string Fingerprint;

        /// <summary>Address in use or tried now, as a text; empty for none.</summary>
        public readonly string Endpoint;

        /// <summary>What became of the newest pairing, null for none.</summary>
        public readonly PairingResult Pairing;

        /// <summary>Why the session refuses this headset, null while it does not.</summary>
        public readonly Refused Refusal;

        /// <summary>How the link failed, when it was the link.</summary>
        public readonly LinkEnd Problem;

        internal readonly SessionClient Client;
        internal readonly SceneFetcher Scene;

        internal static readonly ConnectorView Idle = new ConnectorView(ConnectorPhase.Idle, new Phrase("", ""), new OfferedSession[0], "", "", null, null, default, null, null);

        internal ConnectorView(
            ConnectorPhase phase, Phrase phrase, OfferedSession[] sessions, string fingerprint, string endpoint, PairingResult pairing, Refused refusal, LinkEnd problem, SessionClient client, SceneFetcher scene)
        {
            Phase = phase;
            Phrase = phrase;
            Sessions = sessions;
            Fingerprint = fingerprint;
            Endpoint = endpoint;
            Pairing = pairing;
            Refusal = refusal;
            Problem = problem;
            Client = client;
            Scene = scene;
        }
    }
}
