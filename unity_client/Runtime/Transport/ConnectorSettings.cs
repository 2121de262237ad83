using System;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>What an app gives to a <see cref="SessionConnector"/>. Set it before it is handed over, and leave it alone then.</summary>
    public sealed class ConnectorSettings
    {
        /// <summary>Name that others see, name and version of the app, and the role and devices to join with.</summary>
        public string Name = "headset";
        public string Software = "";
        public string Role = IrisSession.Protocol.Role.Operator;
        public string[] Devices = new string[0];

        /// <summary>See `Hello`.</summary>
        public string[] Capabilities = new string[0];

        /// <summary>Who this app is, and the keys of sessions that it knows.</summary>
        public FileIdentityStore Identity;

        /// <summary>What the device can show, and assets that are kept. The cache belongs to the scene from now on.</summary>
        public SceneBudget Budget = SceneBudget.Quest3;
        public AssetCache Cache;

        /// <summary>Text of the file of `iris-session pair --unity` (<see cref="PairingFile.Name"/>), null for none. It comes before <see cref="Address"/>.</summary>
        public string PairingFile;

        /// <summary>Address or link, as typed or scanned; several with commas, the preferred one first. Empty: sessions that announce themselves.</summary>
        public string Address = "";

        /// <summary>Name of the only session that is wanted of those that announce themselves; empty: any.</summary>
        public string SessionName = "";

        /// <summary>
        /// Try the cable of a headset (`adb reverse`) too, before the network. Only with TLS and the key of a session that is known: another
        /// app of the headset may listen at that port.
        /// </summary>
        public bool UsesCable;

        /// <summary>
        /// Sessions that announce themselves on this very machine may be joined, also without TLS. For a computer; not for a headset, on which
        /// another app may pretend to be a session. An address of this machine that the person typed is used in any case.
        /// </summary>
        public bool UsesThisMachine;

        internal int BeaconPort = BeaconTable.Port;

        /// <summary>None heard for so long is said; an address that does not answer is tried again after this pause.</summary>
        internal long SilenceNs = 3_000_000_000;
        internal int AgainMs = 2_000;

        /// <summary>A session that was lost for so long may have ended: it is looked for anew. By default the grace of a session.</summary>
        internal long LostNs = 30_000_000_000;
        internal Func<ITransport> MakeTransport = () => new WebTransport();
    }
}
