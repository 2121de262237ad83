using System.Collections.Generic;
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

        /// <summary>Number of addresses that its beacons named.</summary>
        internal readonly int HeardAt;

        /// <summary>On each network from which it is heard, with the keys that are known. See <see cref="ConnectorSettings.UsesThisMachine"/>.</summary>
        internal readonly List<WebEndpoint> Endpoints = new List<WebEndpoint>();

        internal OfferedSession(FoundSession found, FileIdentityStore identity, bool usesThisMachine)
        {
            Beacon beacon = found.Beacon;
            Id = beacon.SessionId;
            Name = beacon.SessionName;
            Host = beacon.Host;
            Port = (int)beacon.Web;
            HeardAt = found.Addresses.Count;
            foreach (string address in found.Addresses)
            {
                string host = address.Substring(0, address.LastIndexOf(':')).Trim('[', ']');
                if (!usesThisMachine && HostName.IsLoopback(host)) continue; // whatever the first beacon named
                Endpoints.Add(identity.WithKnownPin(new WebEndpoint(!HostName.IsLoopback(host) || beacon.KeyFingerprint.Length > 0, host, Port)));
            }
            IsKnown = Endpoints.Exists(one => one.Pin != null);
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

        /// <summary>Name of the session; empty while it is not known.</summary>
        public readonly string Session;

        /// <summary>What became of the newest pairing, null for none.</summary>
        public readonly PairingResult Pairing;

        /// <summary>Why the session refuses this headset, null while it does not.</summary>
        public readonly Refused Refusal;

        /// <summary>How the link failed, when it was the link.</summary>
        public readonly LinkEnd Problem;

        internal readonly SessionClient Client;
        internal readonly SceneFetcher Scene;

        /// <summary>Of no connector, or of one that does nothing.</summary>
        public static readonly ConnectorView Idle = new ConnectorView(ConnectorPhase.Idle, ConnectorWords.None);

        internal ConnectorView(
            ConnectorPhase phase, Phrase phrase, string endpoint = "", string session = "", OfferedSession[] sessions = null, PairingResult pairing = null, Refused refusal = null, LinkEnd problem = default,
            SessionClient client = null, SceneFetcher scene = null)
        {
            Phase = phase;
            Phrase = phrase;
            Endpoint = endpoint;
            Session = session;
            Sessions = sessions ?? new OfferedSession[0];
            Pairing = pairing;
            Refusal = refusal;
            Problem = problem;
            Fingerprint = phase == ConnectorPhase.Untrusted ? problem.Fingerprint : "";
            Client = client;
            Scene = scene;
        }

        internal bool IsSame(ConnectorView other)
        {
            bool isSame = Phase == other.Phase && Phrase.What == other.Phrase.What && Phrase.Remedy == other.Phrase.Remedy && Endpoint == other.Endpoint && Session == other.Session
                && Pairing == other.Pairing && Refusal == other.Refusal && Problem.Failure == other.Problem.Failure && Fingerprint == other.Fingerprint && Client == other.Client
                && Sessions.Length == other.Sessions.Length;
            for (int i = 0; isSame && i < Sessions.Length; i++) isSame = Sessions[i] == other.Sessions[i];
            return isSame;
        }
    }
}
