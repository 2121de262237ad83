// One socket of NetMQ 4.0.2, which is ZeroMQ in C#, with the members of LibZmqSocket: for projects that define IRIS_NETMQ and bring its libraries.
#if IRIS_NETMQ
using System;
using System.Collections.Generic;
using System.Net.Sockets;
using System.Runtime.InteropServices;
using System.Threading;
using AsyncIO;
using IrisSession.Core;
using IrisSession.Protocol;
using NetMQ;
using NetMQ.Monitoring;
using NetMQ.Sockets;

namespace IrisSession.Transport
{
    /// <summary>
    /// A socket with the settings of all sockets to a session. Nothing waits, but <see cref="Wait"/>, and <see cref="TryConnect"/> for a name.
    ///
    /// With keys NetMQ still speaks in the clear to a peer whose greeting is of ZMTP 2 or older, without saying so. So frames that were not
    /// decrypted are refused, and a connection that is watched is open when the answer to a first message was: all before it is a heartbeat.
    /// </summary>
    internal sealed class NetMqSocket : IDisposable
    {
        private const int MaxBytes = 64 << 20;

        /// <summary>Where a frame that was decrypted begins in its buffer: after a byte of flags, which other frames do not have (4.0.2.1).</summary>
        private const int DecryptedOffset = 1;
        private static int numbers;
        private readonly string prefix;
        private readonly bool isEncrypted;
        private readonly NetMQSocket socket;
        private readonly NetMQSelector.Item item;
        private PairSocket events;
        private NetMQMonitor monitor;
        private bool isProven;

        /// <summary>AsyncIO would call functions of Windows by P/Invoke, also in Unity's editor and on HoloLens.</summary>
        static NetMqSocket() { ForceDotNet.Force(); }

        /// <param name="keys">Null: not encrypted.</param>
        /// <exception cref="ArgumentException">NetMQ does not take the keys.</exception>
        public NetMqSocket(IntPtr context, int kind, ZmqKeys keys = null)
        {
            prefix = "inproc://iris-session-" + context + "-";
            isEncrypted = keys != null;
            socket = kind == LibZmq.Dealer ? new DealerSocket() : kind == LibZmq.Sub ? new SubscriberSocket() : kind == LibZmq.Pull ? new PullSocket() : (NetMQSocket)new PushSocket();
            item = new NetMQSelector.Item(socket, PollEvents.PollIn);
            SocketOptions options = socket.Options;
            options.Linger = TimeSpan.Zero;
            options.MaxMsgSize = MaxBytes;
            options.TcpKeepalive = true; // a peer that vanished is noticed in 11 s
            options.TcpKeepaliveIdle = TimeSpan.FromSeconds(5);
            options.TcpKeepaliveInterval = TimeSpan.FromSeconds(2);
            options.TcpKeepaliveCnt = 3;
            if (keys == null) return;
            try
            {
                options.CurveServerCertificate = NetMQCertificate.FromPublicKey(keys.ServerPublic);
                options.CurveCertificate = new NetMQCertificate(keys.Secret, keys.Public);
            }
            catch (Exception error) when (error is ArgumentException || error is IndexOutOfRangeException)
            {
                Dispose();
                throw new ArgumentException("NetMQ does not take the keys: they are not Z85 text", error);
            }
        }

        /// <summary>NetMQ has one context for all of a program. A number keeps the names of one transport apart from those of another.</summary>
        public static IntPtr OpenContext() { return (IntPtr)Interlocked.Increment(ref numbers); }

        /// <summary>Wait as long as a last bye may take: a program may end then, and with it NetMQ's threads, which do not say when it is sent.</summary>
        public static void CloseContext(IntPtr context) { Thread.Sleep(ZmqTransport.LingerMs); }

        /// <summary>State of the connection of a socket that <see cref="Watch"/> was called for. NetMQ does not say why a handshake failed.</summary>
        public ZmqLink Link { get; private set; }

        public void Set(int option, int value)
        {
            switch (option)
            {
                case LibZmq.Linger: socket.Options.Linger = TimeSpan.FromMilliseconds(value); break;
                case LibZmq.SendMark: socket.Options.SendHighWatermark = value; break;
                case LibZmq.ReceiveMark: socket.Options.ReceiveHighWatermark = value; break;
                case LibZmq.ReceiveBuffer: socket.Options.ReceiveBuffer = value; break;
                default: throw new ArgumentOutOfRangeException(nameof(option));
            }
        }

        public void Set(int option, byte[] topic)
        {
            SubscriberSocket subscriber = (SubscriberSocket)socket;
            if (option == LibZmq.Subscribe) subscriber.Subscribe(topic);
            else subscriber.Unsubscribe(topic);
        }

        /// <summary>Connect to `host:port`, of IPv6 with brackets. False: it is no address.</summary>
        public bool TryConnect(string authority)
        {
            if (authority.IndexOf('[') >= 0) socket.Options.IPv4Only = false;
            try
            {
                socket.Connect("tcp://" + authority);
                return true;
            }
            catch (Exception error) when (error is NetMQException || error is SocketException || error is ArgumentException)
            {
                return false;
            }
        }

        /// <summary>Connect within this program.</summary>
        public void ConnectInside(string name) { socket.Connect(prefix + name); }

        public void BindInside(string name) { socket.Bind(prefix + name); }

        /// <summary>Follow the connection, before it is made. There will be no other: what is proven of one holds for this one alone.</summary>
        public void Watch()
        {
            socket.Options.ReconnectInterval = TimeSpan.FromHours(1); // never: -1 ms throws on NetMQ's thread where no socket can be had
            string name = prefix + Interlocked.Increment(ref numbers);
            socket.Monitor(name, SocketEvents.Connected | SocketEvents.ConnectRetried | SocketEvents.Disconnected);
            events = new PairSocket();
            events.Connect(name);
            monitor = new NetMQMonitor(events, name);
            monitor.EventReceived += (sender, happened) => Note(happened.SocketEvent);
        }

        /// <summary>Take what happened to the connection since the last call. Once lost it stays so.</summary>
        public ZmqLink TakeLink()
        {
            while (events != null && events.HasIn) events.Poll(TimeSpan.Zero);
            return Link;
        }

        /// <summary>Send a frame. False: the queue is full.</summary>
        public bool TrySend(byte[] bytes, int count, bool hasMore = false)
        {
            Msg frame = new Msg();
            frame.InitPool(count);
            frame.Put(bytes, 0, count);
            bool isSent = socket.TrySend(ref frame, TimeSpan.Zero, hasMore);
            frame.Close();
            return isSent;
        }

        /// <summary>Take a message. False: there is none. Of one with too many frames the first are taken.</summary>
        public bool TryReceive(Multipart message)
        {
            message.Clear();
            int end = 0;
            bool isClear = false;
            Msg frame = new Msg();
            frame.InitEmpty();
            for (bool hasMore = true; hasMore;)
            {
                if (!socket.TryReceive(ref frame, TimeSpan.Zero)) return false; // frames of one message come together
                hasMore = frame.HasMore;
                MemoryMarshal.TryGetArray<byte>(frame.SliceAsMemory(), out ArraySegment<byte> bytes);
                isClear |= isEncrypted && bytes.Offset != DecryptedOffset;
                if (message.Count == Multipart.MaxFrames) continue;
                if (message.Buffer.Length < end + bytes.Count) Array.Resize(ref message.Buffer, Math.Max(2 * message.Buffer.Length, end + bytes.Count));
                Buffer.BlockCopy(bytes.Array, bytes.Offset, message.Buffer, end, bytes.Count);
                message.Add(end, bytes.Count);
                end += bytes.Count;
            }
            frame.Close();
            if (isClear) Link = ZmqLink.Clear;
            if (isClear || monitor == null || !isEncrypted || isProven) return !isClear;
            isProven = true;
            if (Link == ZmqLink.Opening) Link = ZmqLink.Open;
            return false; // the answer to our first message
        }

        public void Dispose()
        {
            if (socket.IsDisposed) return;
            monitor?.Dispose();
            events?.Dispose();
            socket.Dispose();
        }

        /// <summary>Wait until one of the sockets, or what became of one's connection, can be taken, or the time is over.</summary>
        public static void Wait(List<NetMqSocket> sockets, int milliseconds)
        {
            List<NetMQSelector.Item> items = new List<NetMQSelector.Item>();
            foreach (NetMqSocket socket in sockets)
            {
                items.Add(socket.item);
                if (socket.events != null) items.Add(new NetMQSelector.Item(socket.events, PollEvents.PollIn));
            }
            new NetMQSelector().Select(items.ToArray(), items.Count, milliseconds);
        }

        private void Note(SocketEvents what)
        {
            if (Link != ZmqLink.Opening && Link != ZmqLink.Open) return;
            if (what != SocketEvents.Connected) Link = ZmqLink.Lost;
            else if (!isEncrypted) Link = ZmqLink.Open;
            else
            {
                WireWriter writer = new WireWriter();
                new ClientEnvelope { Version = Wire.Version, Message = new Heartbeat() }.WriteTo(writer);
                TrySend(writer.Data, writer.Length); // docs/protocol.md, section 4: any message of an unknown connection is answered
            }
        }
    }
}
#endif
