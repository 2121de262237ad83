// From a link or a typed address to the gateway of the session: its port is in the introduction that the session writes to every peer
// (docs/protocol.md, discovery). Nothing in it is proof: the key of the gateway is checked when it is connected to.
using System;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>One look-up on a thread of its own. Poll <see cref="IsDone"/>.</summary>
    public sealed class GatewayFinder
    {
        /// <summary>Time for the introduction: without one the usual port is taken [ns].</summary>
        private const long IntroductionNs = 3_000_000_000;

        private readonly PairingLink link;
        private readonly Interrupt interrupt = new Interrupt();
        private readonly Thread thread;
        private volatile bool isDone;

        public GatewayFinder(PairingLink link)
        {
            this.link = link;
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session find" };
        }

        public bool IsDone { get { return isDone; } }

        /// <summary>Where the gateway is, once done; null when the session has none, or is another one: `End`.</summary>
        public WebEndpoint Endpoint { get; private set; }

        public LinkEnd End { get; private set; }

        /// <summary>What the session says of itself, null when it did not answer: the port is a guess then.</summary>
        public Introduction Introduction { get; private set; }

        public void Start()
        {
            thread.Start();
        }

        /// <summary>End it. Returns within a second: whether its thread has ended.</summary>
        public bool Stop()
        {
            interrupt.Set();
            return thread.Join(950);
        }

        private void Run()
        {
            try
            {
                if (link.ControlPort > 1) Introduction = ReadIntroduction();
            }
            catch (Exception)
            {
                // not there, or of an older session: its gateway may be where gateways usually are
            }
            try
            {
                Decide();
            }
            catch (ArgumentException error)
            {
                End = new LinkEnd(LinkFailure.NotAGateway, 0, error.Message);
            }
            isDone = true;
        }

        private Introduction ReadIntroduction()
        {
            byte[] bytes = new byte[BeaconTable.MaxIntroductionBytes + 1];
            int count = 0;
            long untilNs = MonotonicClock.NowNs + IntroductionNs;
            using (InterruptibleStream stream = InterruptibleStream.Connect(link.Host, link.ControlPort + BeaconTable.IntroductionFromControl, untilNs, interrupt))
            {
                for (int got = 1; got > 0 && count < bytes.Length; count += got) got = stream.Read(bytes, count, bytes.Length - count);
            }
            return BeaconTable.DecodeIntroduction(bytes, count, link.ControlPort);
        }

        private void Decide()
        {
            bool isSecure = link.IsEncrypted;
            int port = link.WebPort;
            if (Introduction != null)
            {
                isSecure = Introduction.ServerKey.Length > 0 || !link.IsLoopback;
                port = (int)Introduction.Beacon.Web;
            }
            if (port == 0) End = new LinkEnd(LinkFailure.NotAGateway, 0, "the session at " + link + " has no web gateway");
            else Endpoint = new WebEndpoint(isSecure, link.Host, port);
        }
    }
}
