// From what an app was given (a pairing file, an address, a link, or nothing but a network) to a running session.
//
// All calls belong to one thread, the engine's. None waits but `Stop`; none throws what a network or a file did.
using System;

namespace IrisSession.Transport
{
    /// <summary>Finds a session, pairs with it, and joins it. Start it once, poll it each frame, stop it once.</summary>
    public sealed class SessionConnector
    {
        private readonly ConnectorSettings settings;

        public SessionConnector(ConnectorSettings settings)
        {
            this.settings = settings;
        }

        /// <summary>What it does now, as of the last <see cref="Poll"/>.</summary>
        public ConnectorView View { get; private set; } = ConnectorView.Idle;

        /// <summary>The session, null until `Running`, and again after it. Started and stopped by this.</summary>
        public SessionClient Client { get { return View.Client; } }

        /// <summary>The scene of <see cref="Client"/>, null with it.</summary>
        public SceneFetcher Scene { get { return View.Scene; } }

        public void Start()
        {
        }

        /// <summary>Leave the session and end all threads. Returns within about a second: whether they have ended.</summary>
        public bool Stop()
        {
            return true;
        }

        /// <summary>Take what happened. Call it each frame: it waits for nothing, and allocates nothing while nothing changes.</summary>
        /// <returns>Whether <see cref="View"/> is another one.</returns>
        public bool Poll()
        {
            return false;
        }

        /// <summary>Join one of `View.Sessions`.</summary>
        public void Choose(OfferedSession session)
        {
        }

        /// <summary>Leave what is there and go to an address or link, typed or scanned; one with a join code pairs. Empty: sessions that announce themselves.</summary>
        public void Enter(string address)
        {
        }

        /// <summary>Pair by a join code, as typed, with the session whose key is not known, or that refused this headset.</summary>
        public void EnterCode(string code)
        {
        }

        /// <summary>Accept the key whose `View.Fingerprint` the person has compared, and join.</summary>
        public void Trust()
        {
        }

        /// <summary>Begin again with what was given or entered last.</summary>
        public void Retry()
        {
        }
    }
}
