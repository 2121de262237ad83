// Listens for the beacons of sessions (UDP 7720) on a thread of its own. Android passes broadcasts on only while the app holds a
// multicast lock (WifiManager.createMulticastLock), which the application has to take while this runs.
using System;
using System.Collections.Generic;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Sessions that announce themselves. Start it, poll it, stop it.</summary>
    public sealed class BeaconListener
    {
        /// <summary>A session sends five beacons a second: one that was silent for so long has ended [ns].</summary>
        private const long SilentNs = 3_000_000_000;
        private const int LookMs = 50;

        private readonly int port;
        private readonly BeaconTable table = new BeaconTable(); // guarded by itself
        private readonly Interrupt interrupt = new Interrupt();
        private readonly Thread thread;
        private volatile string problem = "";

        public BeaconListener(int port = BeaconTable.Port)
        {
            this.port = port;
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session beacons" };
        }

        /// <summary>Why nothing can be heard, in words of the system; empty while it listens.</summary>
        public string Problem { get { return problem; } }

        /// <summary>Beacons of another version of the protocol that came.</summary>
        public long OtherVersions { get { lock (table) return table.OtherVersion; } }

        public void Start()
        {
            thread.Start();
        }

        /// <summary>Return the sessions that were heard lately.</summary>
        public List<FoundSession> ListSessions()
        {
            lock (table)
            {
                table.RemoveSilent(MonotonicClock.NowNs - SilentNs);
                return table.ListSessions();
            }
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
                using (Socket socket = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
                {
                    socket.SetSocketOption(SocketOptionLevel.Socket, SocketOptionName.ReuseAddress, true);
                    socket.Bind(new IPEndPoint(IPAddress.Any, port));
                    socket.ReceiveTimeout = LookMs;
                    byte[] bytes = new byte[BeaconTable.MaxBeaconBytes + 1];
                    while (!interrupt.IsSet) if (socket.Poll(1000 * LookMs, SelectMode.SelectRead)) Receive(socket, bytes);
                }
            }
            catch (Exception error)
            {
                problem = error.Message;
            }
        }

        private void Receive(Socket socket, byte[] bytes)
        {
            EndPoint sender = new IPEndPoint(IPAddress.Any, 0);
            int count;
            try
            {
                count = socket.ReceiveFrom(bytes, ref sender);
            }
            catch (SocketException error) when (error.SocketErrorCode == SocketError.MessageSize || error.SocketErrorCode == SocketError.ConnectionReset || error.SocketErrorCode == SocketError.TimedOut)
            {
                return;
            }
            lock (table) table.Process(bytes, 0, count, ((IPEndPoint)sender).Address.ToString(), MonotonicClock.NowNs);
        }
    }
}
