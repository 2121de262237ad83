// A TCP connection whose waits end when another thread asks for it, whatever the runtime does with sockets that are closed meanwhile.
//
// What waits looks every `LookMs` whether it has to stop. The socket blocks, but is only used when it is ready, for pieces that it has
// room for: of one that does not block, Mono 6.8's `Send` spins until everything is sent. Partial writes are continued here.
using System;
using System.IO;
using System.Net;
using System.Net.Sockets;
using System.Threading;

namespace IrisSession.Transport
{
    /// <summary>
    /// Stream over a socket. One thread reads, one writes. Any thread may call <see cref="Interrupt"/>, after which all calls throw.
    /// Only the thread that made it disposes of it.
    /// </summary>
    internal sealed class InterruptibleStream : Stream
    {
        /// <summary>Longest time until an interrupt or a deadline is seen [ms].</summary>
        private const int LookMs = 50;

        /// <summary>Bytes that the system keeps to send: an e-stop goes behind them.</summary>
        private const int SendBytes = 16 << 10;

        /// <summary>Bytes that a socket which is ready to be written to takes at once.</summary>
        private const int PieceBytes = 4096;

        /// <summary>Time for an address that is not the last one [ns]: in a local network it answers within a tenth.</summary>
        private const long AddressNs = 500_000_000;

        private readonly Interrupt interrupt;
        private readonly Socket socket;
        private volatile bool isShutDown;
        private long deadlineNs = long.MaxValue;

        private InterruptibleStream(Socket socket, Interrupt interrupt)
        {
            this.socket = socket;
            this.interrupt = interrupt;
        }

        /// <summary>Time at which reads and writes fail [ns of the monotonic clock]; `long.MaxValue` for never.</summary>
        public long DeadlineNs
        {
            get { return Interlocked.Read(ref deadlineNs); }
            set { Interlocked.Exchange(ref deadlineNs, value); }
        }

        public override bool CanRead { get { return true; } }

        public override bool CanWrite { get { return true; } }

        public override bool CanSeek { get { return false; } }

        public override long Length { get { throw new NotSupportedException(); } }

        public override long Position { get { throw new NotSupportedException(); } set { throw new NotSupportedException(); } }

        /// <summary>Connect to the first address of a host that answers.</summary>
        /// <exception cref="TransportException">None does, or it was interrupted.</exception>
        public static InterruptibleStream Connect(string host, int port, long deadlineNs, Interrupt interrupt)
        {
            return Connect(host, Resolve(host, deadlineNs, interrupt), port, deadlineNs, interrupt);
        }

        /// <summary>The same for addresses that are known. One that swallows everything, as behind a wrong route, leaves time for the next.</summary>
        internal static InterruptibleStream Connect(string host, IPAddress[] addresses, int port, long deadlineNs, Interrupt interrupt)
        {
            TransportException last = null;
            for (int i = 0; i < addresses.Length; i++)
            {
                long untilNs = i + 1 < addresses.Length ? Math.Min(deadlineNs, MonotonicClock.NowNs + AddressNs) : deadlineNs;
                try
                {
                    InterruptibleStream stream = Connect(addresses[i], port, untilNs, interrupt);
                    stream.DeadlineNs = deadlineNs;
                    return stream;
                }
                catch (TransportException error)
                {
                    last = error;
                }
            }
            throw last ?? new TransportException(LinkFailure.Unreachable, host + " has no address");
        }

        public override int Read(byte[] buffer, int offset, int count)
        {
            while (true)
            {
                Wait(SelectMode.SelectRead);
                int got = socket.Receive(buffer, offset, count, SocketFlags.None, out SocketError error);
                if (error == SocketError.Success) return got;
                if (isShutDown) return 0; // Mono says `Interrupted` then, again and again
                if (!IsTemporary(error)) throw new IOException("the connection was lost: " + error);
            }
        }

        public override void Write(byte[] buffer, int offset, int count)
        {
            while (count > 0)
            {
                Wait(SelectMode.SelectWrite);
                int sent = socket.Send(buffer, offset, Math.Min(count, PieceBytes), SocketFlags.None, out SocketError error);
                if (error != SocketError.Success && !IsTemporary(error)) throw new IOException("the connection was lost: " + error);
                offset += Math.Max(sent, 0);
                count -= Math.Max(sent, 0);
            }
        }

        public override void Flush()
        {
        }

        public override long Seek(long offset, SeekOrigin origin)
        {
            throw new NotSupportedException();
        }

        public override void SetLength(long value)
        {
            throw new NotSupportedException();
        }

        /// <summary>Say to the other end that nothing more comes.</summary>
        public void Shutdown()
        {
            isShutDown = true;
            try
            {
                socket.Shutdown(SocketShutdown.Both);
            }
            catch (SocketException)
            {
                // it is closed already
            }
            catch (ObjectDisposedException)
            {
                // the same
            }
        }

        protected override void Dispose(bool disposing)
        {
            if (disposing) socket.Close();
            base.Dispose(disposing);
        }

        private static IPAddress[] Resolve(string host, long deadlineNs, Interrupt interrupt)
        {
            if (IPAddress.TryParse(host, out IPAddress literal)) return new[] { literal };
            // Not the resolver, which may ask a name server: the cable is there without any network.
            if (host == "localhost") return new[] { IPAddress.Loopback, IPAddress.IPv6Loopback };
            try
            {
                IAsyncResult asked = Dns.BeginGetHostAddresses(host, null, null); // cannot be cancelled: its thread of the pool ends by itself
                while (!asked.AsyncWaitHandle.WaitOne(LookMs)) Check(deadlineNs, interrupt);
                return Dns.EndGetHostAddresses(asked);
            }
            catch (Exception error) when (error is SocketException || error is ArgumentException)
            {
                throw new TransportException(LinkFailure.Unreachable, "the name " + host + " is not known: " + error.Message);
            }
        }

        private static InterruptibleStream Connect(IPAddress address, int port, long deadlineNs, Interrupt interrupt)
        {
            Socket socket = new Socket(address.AddressFamily, SocketType.Stream, ProtocolType.Tcp);
            try
            {
                socket.Blocking = false;
                socket.NoDelay = true;
                try
                {
                    socket.Connect(new IPEndPoint(address, port));
                }
                catch (SocketException error) when (IsTemporary(error.SocketErrorCode))
                {
                    while (!socket.Poll(1000 * LookMs, SelectMode.SelectWrite) && !socket.Poll(0, SelectMode.SelectError)) Check(deadlineNs, interrupt);
                }
                int failed = (int)socket.GetSocketOption(SocketOptionLevel.Socket, SocketOptionName.Error);
                if (failed != 0) throw new SocketException(failed);
                socket.Blocking = true;
                socket.SendTimeout = socket.ReceiveTimeout = LookMs;
                socket.SendBufferSize = SendBytes;
                InterruptibleStream stream = new InterruptibleStream(socket, interrupt) { DeadlineNs = deadlineNs };
                socket = null;
                return stream;
            }
            catch (SocketException error)
            {
                throw new TransportException(LinkFailure.Unreachable, address + ":" + port + " does not answer: " + error.Message);
            }
            finally
            {
                socket?.Close();
            }
        }

        private static bool IsTemporary(SocketError error)
        {
            return error == SocketError.WouldBlock || error == SocketError.InProgress || error == SocketError.IOPending
                || error == SocketError.AlreadyInProgress || error == SocketError.TimedOut || error == SocketError.Interrupted
                || error == SocketError.NoBufferSpaceAvailable;
        }

        private static void Check(long deadlineNs, Interrupt interrupt)
        {
            if (interrupt.IsSet) throw new TransportException(LinkFailure.None, "the connection was closed");
            if (MonotonicClock.NowNs >= deadlineNs) throw new TransportException(LinkFailure.Unreachable, "no answer in time");
        }

        private void Wait(SelectMode mode)
        {
            do
            {
                Check(DeadlineNs, interrupt);
            }
            while (!socket.Poll(1000 * LookMs, mode));
        }
    }

    /// <summary>Tells the threads of a connection to stop. Set once, from any thread.</summary>
    internal sealed class Interrupt
    {
        private volatile bool isSet;

        public bool IsSet { get { return isSet; } }

        public void Set()
        {
            isSet = true;
        }
    }
}
