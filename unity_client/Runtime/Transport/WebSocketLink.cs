// One WebSocket of a gateway on two threads of its own: one connects and reads, one writes. Nothing that others call here waits.
using System;
using System.Security.Cryptography;
using System.Text;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Receives what comes. Called on the thread of the link, which owns `message` until the call returns.</summary>
    internal interface ILinkListener
    {
        /// <summary>The WebSocket is open.</summary>
        void OnOpen(WebSocketLink link);

        /// <summary>A message came. The listener may exchange `message` for another one. False: it is not taken, close the link.</summary>
        bool OnMessage(WebSocketLink link, int channel, ref Multipart message);

        /// <summary>The link has ended: nothing more comes.</summary>
        void OnEnd(WebSocketLink link);
    }

    /// <summary>A WebSocket, opened once. Stop it from any thread; its threads end within a fraction of a second.</summary>
    internal sealed class WebSocketLink
    {
        /// <summary>Bytes that may wait to be written: above, messages are not taken. Two frames of samples: an e-stop goes behind what waits here.</summary>
        public const int MaxWaitingBytes = 8 << 10;

        /// <summary>Buffers for writing above this size are not used again.</summary>
        private const int KeptWriteBytes = 128 << 10;

        private const int ReadBytes = 64 << 10;

        /// <summary>Buffers of messages above this size are not used again: state of 65,535 bodies and most media frames have less.</summary>
        private const int KeptBytes = 2 << 20;

        /// <summary>Time for the last messages and the close frame of a link that ends [ns].</summary>
        private const long DefaultLingerNs = 500_000_000;
        private const string Guid = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"; // RFC 6455, section 1.3

        private readonly WebEndpoint endpoint;
        private readonly string path;
        private readonly int maxBytes;
        private readonly ILinkListener listener;
        private readonly bool takesAnyKey;
        private readonly long lingerNs;
        private readonly Interrupt interrupt = new Interrupt();
        private readonly object gate = new object(); // guards what follows; never held while a socket is used
        private readonly WebSocketWriter writer = new WebSocketWriter();
        private bool isOpen;
        private bool isStopping; // what waits is still written
        private bool hasEnded;
        private bool isAsked; // we end it, not the other end
        private Thread reading;
        private volatile HttpConnection connection;
        private Multipart incoming = new Multipart();

        /// <param name="endpoint">Where the gateway is.</param>
        /// <param name="path">Path of the WebSocket.</param>
        /// <param name="maxBytes">Most bytes of a message.</param>
        /// <param name="listener">What receives.</param>
        /// <param name="takesAnyKey">See <see cref="HttpConnection"/>.</param>
        /// <param name="lingerNs">Time for the last messages and the close frame when it ends [ns].</param>
        public WebSocketLink(
            WebEndpoint endpoint, string path, int maxBytes, ILinkListener listener, bool takesAnyKey = false, long lingerNs = DefaultLingerNs)
        {
            this.endpoint = endpoint;
            this.path = path;
            this.maxBytes = maxBytes;
            this.listener = listener;
            this.takesAnyKey = takesAnyKey;
            this.lingerNs = lingerNs;
        }

        /// <summary>How it ended, once `HasEnded`.</summary>
        public LinkEnd End { get; private set; }

        /// <summary>True from its opening until it ends or is stopped.</summary>
        public bool IsOpen { get { lock (gate) return isOpen && !isStopping; } }

        /// <summary>True when nothing more comes and both threads are about to return.</summary>
        public bool HasEnded { get { lock (gate) return hasEnded; } }

        /// <summary>Messages that came and were malformed.</summary>
        public long Malformed { get; private set; }

        /// <summary>Hash of the key of the other end, null without TLS.</summary>
        public byte[] CertificateKey { get { return connection?.CertificateHash; } }

        public void Start()
        {
            reading = new Thread(Run) { IsBackground = true, Name = "iris-session read " + path };
            reading.Start();
        }

        /// <summary>Queue a message with one frame. False: the link is not open, or does not write fast enough.</summary>
        public bool TrySend(int channel, byte[] bytes, int count)
        {
            lock (gate)
            {
                if (!isOpen || isStopping || writer.Length > MaxWaitingBytes) return false;
                writer.AppendMessage(channel, bytes, count);
                Monitor.PulseAll(gate);
                return true;
            }
        }

        /// <summary>End it soon: what waits and a close frame are written if the socket takes them at once.</summary>
        public void Stop()
        {
            lock (gate)
            {
                if (isStopping) return;
                isStopping = isAsked = true;
                if (isOpen) writer.AppendClose(1000);
                else interrupt.Set();
                connection?.SetDeadline(MonotonicClock.NowNs + lingerNs);
                Monitor.PulseAll(gate);
            }
        }

        /// <summary>End it now.</summary>
        public void Abort()
        {
            interrupt.Set();
            lock (gate)
            {
                isStopping = isAsked = true;
                Monitor.PulseAll(gate);
            }
        }

        /// <summary>Wait for the end of its threads. False: they still run.</summary>
        public bool Join(int milliseconds)
        {
            return reading == null || reading.Join(milliseconds);
        }

        private void Run()
        {
            Thread writing = null;
            try
            {
                using (HttpConnection opened = Open())
                {
                    writing = new Thread(() => Write(opened)) { IsBackground = true, Name = "iris-session write " + path };
                    lock (gate) isOpen = true;
                    writing.Start();
                    listener.OnOpen(this);
                    try
                    {
                        ReadMessages(opened);
                    }
                    finally
                    {
                        EndWriting(opened, writing);
                    }
                }
            }
            catch (TransportException error)
            {
                End = error.End;
            }
            catch (Exception error) // whatever a runtime's TLS throws when it is ended: it must not end the app
            {
                End = new LinkEnd(LinkFailure.Unreachable, 0, error.Message);
            }
            lock (gate)
            {
                isOpen = false;
                if (isAsked) End = default;
                hasEnded = true;
            }
            listener.OnEnd(this);
        }

        private HttpConnection Open()
        {
            HttpConnection opened = new HttpConnection(endpoint, interrupt, takesAnyKey);
            try
            {
                Shake(opened);
            }
            catch (Exception error) when (HttpConnection.IsOfConnection(error))
            {
                opened.Dispose();
                throw opened.ToLinkException(error, interrupt);
            }
            lock (gate)
            {
                opened.SetDeadline(isStopping ? MonotonicClock.NowNs + lingerNs : long.MaxValue);
                connection = opened;
            }
            return opened;
        }

        /// <summary>Make it a WebSocket (RFC 6455, section 4.1).</summary>
        private void Shake(HttpConnection opened)
        {
            byte[] nonce = new byte[16];
            using (RandomNumberGenerator random = RandomNumberGenerator.Create()) random.GetBytes(nonce);
            string key = Convert.ToBase64String(nonce);
            opened.SendRequest(
                path,
                "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + key
                + "\r\nSec-WebSocket-Protocol: " + WebMessage.Subprotocol + "\r\n");
            HttpHead head = opened.ReadHead();
            if (head.Status != 101)
            {
                string text = head.ContentLength > 0 ? opened.ReadText(head, 256) : "";
                throw new TransportException(LinkFailure.NotAGateway, endpoint.Authority + " answers " + head.Status + (text.Length == 0 ? "" : ": " + text), head.Status);
            }
            string expected;
            using (SHA1 sha = SHA1.Create()) expected = Convert.ToBase64String(sha.ComputeHash(Encoding.ASCII.GetBytes(key + Guid)));
            bool isOurs = head["Sec-WebSocket-Accept"] == expected && head["Sec-WebSocket-Protocol"] == WebMessage.Subprotocol
                && head["Sec-WebSocket-Extensions"].Length == 0
                && string.Equals(head["Upgrade"], "websocket", StringComparison.OrdinalIgnoreCase)
                && head["Connection"].IndexOf("upgrade", StringComparison.OrdinalIgnoreCase) >= 0;
            if (!isOurs) throw new TransportException(LinkFailure.NotAGateway, endpoint.Authority + " does not speak " + WebMessage.Subprotocol);
        }

        private void ReadMessages(HttpConnection opened)
        {
            WebSocketReader reader = new WebSocketReader(maxBytes);
            byte[] bytes = new byte[ReadBytes];
            while (true)
            {
                int count = opened.Read(bytes, 0, bytes.Length);
                if (count == 0)
                {
                    End = new LinkEnd(LinkFailure.Unreachable, 0, "the connection was lost");
                    return;
                }
                int at = 0;
                try
                {
                    while (at < count)
                    {
                        WebSocketEvent came = reader.Read(bytes, ref at, count);
                        if (came == WebSocketEvent.Message && !Deliver(reader))
                        {
                            End = new LinkEnd(LinkFailure.Overflow, 0, "messages came faster than they were read");
                            return;
                        }
                        if (came == WebSocketEvent.Ping) QueuePong(reader);
                        if (came != WebSocketEvent.Close) continue;
                        End = new LinkEnd(LinkFailure.Closed, reader.CloseCode, reader.CloseReason);
                        return;
                    }
                }
                catch (TransportException error)
                {
                    lock (gate) writer.AppendClose(error.End.Code);
                    throw;
                }
            }
        }

        private void QueuePong(WebSocketReader reader)
        {
            lock (gate)
            {
                if (writer.Length > MaxWaitingBytes) return; // RFC 6455, section 5.5.3: the newest ping may be answered alone
                writer.AppendPong(reader.Control, reader.ControlLength);
                Monitor.PulseAll(gate);
            }
        }

        private bool Deliver(WebSocketReader reader)
        {
            int length = reader.MessageLength;
            byte[] spare = incoming.Buffer.Length <= KeptBytes ? incoming.Buffer : Array.Empty<byte>();
            incoming.Buffer = reader.TakeMessage(spare);
            int channel = WebMessage.Unpack(incoming, length);
            if (channel >= 0) return listener.OnMessage(this, channel, ref incoming);
            Malformed++;
            return true;
        }

        private void Write(HttpConnection opened)
        {
            byte[] spare = new byte[4096];
            try
            {
                while (true)
                {
                    byte[] bytes;
                    int count;
                    lock (gate)
                    {
                        while (writer.Length == 0 && !isStopping) Monitor.Wait(gate);
                        count = writer.Length;
                        if (count == 0 || interrupt.IsSet) break;
                        bytes = writer.Take(spare);
                    }
                    opened.Write(bytes, count);
                    spare = bytes.Length <= KeptWriteBytes ? bytes : new byte[4096];
                }
            }
            catch (Exception)
            {
                // the thread that reads finds the same, and says so
            }
            lock (gate)
            {
                isOpen = false;
                Monitor.PulseAll(gate);
            }
            opened.Shutdown();
        }

        /// <summary>Let the writer write what waits, for a moment, and wait for its end.</summary>
        private void EndWriting(HttpConnection opened, Thread writing)
        {
            lock (gate)
            {
                isOpen = false;
                if (!isStopping) opened.SetDeadline(MonotonicClock.NowNs + lingerNs);
                isStopping = true;
                Monitor.PulseAll(gate);
            }
            writing.Join();
        }
    }
}
