// One socket of libzmq, and waiting for several. Each belongs to one thread at a time.
using System;
using System.Collections.Generic;
using System.Runtime.InteropServices;
using System.Text;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>What became of the connection of a socket.</summary>
    internal enum ZmqLink
    {
        Opening,
        Open,
        Lost,

        /// <summary>The session does not know our key.</summary>
        Refused,

        /// <summary>We have keys, and the session does not encrypt. Only <see cref="NetMqSocket"/> gets so far.</summary>
        Clear,
    }

    /// <summary>A socket with the settings of all sockets to a session. Nothing waits, but <see cref="Wait"/>.</summary>
    internal sealed class LibZmqSocket : IDisposable
    {
        private const int MaxBytes = 64 << 20;
        private static readonly bool IsWindows = Environment.OSVersion.Platform == PlatformID.Win32NT;
        private static readonly int FdBytes = IsWindows ? IntPtr.Size : 4;
        private static readonly int ItemBytes = (IntPtr.Size + FdBytes + 4 + IntPtr.Size - 1) / IntPtr.Size * IntPtr.Size;
        private static int monitors;
        private readonly IntPtr context;
        private readonly IntPtr frame = Marshal.AllocHGlobal(LibZmq.MessageBytes);
        private readonly Multipart happened = new Multipart();
        private IntPtr handle;
        private LibZmqSocket monitor;

        /// <param name="keys">Null: not encrypted.</param>
        /// <exception cref="ArgumentException">libzmq does not take the keys: it would go on without them, in the clear.</exception>
        public LibZmqSocket(IntPtr context, int kind, ZmqKeys keys = null)
        {
            this.context = context;
            handle = LibZmq.zmq_socket(context, kind);
            Set(LibZmq.Linger, 0);
            long most = MaxBytes;
            LibZmq.zmq_setsockopt(handle, LibZmq.MaxMessageBytes, ref most, (UIntPtr)8);
            Set(LibZmq.KeepAlive, 1); // a peer that vanished is noticed in 11 s
            Set(LibZmq.KeepAliveIdle, 5);
            Set(LibZmq.KeepAliveInterval, 2);
            Set(LibZmq.KeepAliveCount, 3);
            if (keys == null) return;
            bool isTaken = Set(LibZmq.CurveServerKey, Text(keys.ServerPublic)) && Set(LibZmq.CurvePublicKey, Text(keys.Public)) && Set(LibZmq.CurveSecretKey, Text(keys.Secret));
            if (isTaken) return;
            Dispose();
            throw new ArgumentException("libzmq does not take the keys: they are not Z85 text, or it was built without CURVE");
        }

        public static IntPtr OpenContext() { return LibZmq.zmq_ctx_new(); }

        /// <summary>Wait until all sockets are closed and what lingers is sent.</summary>
        public static void CloseContext(IntPtr context) { LibZmq.zmq_ctx_term(context); }

        /// <summary>State of the connection of a socket that <see cref="Watch"/> was called for.</summary>
        public ZmqLink Link { get; private set; }

        public void Set(int option, int value)
        {
            LibZmq.zmq_setsockopt(handle, option, ref value, (UIntPtr)4);
        }

        public bool Set(int option, byte[] value)
        {
            return LibZmq.zmq_setsockopt(handle, option, value, (UIntPtr)value.Length) == 0;
        }

        /// <summary>The socket of libzmq.</summary>
        public IntPtr Handle { get { return handle; } }

        /// <summary>Connect to `host:port`, of IPv6 with brackets. False: it is no address.</summary>
        public bool TryConnect(string authority)
        {
            if (authority.IndexOf('[') >= 0) Set(LibZmq.Ipv6, 1);
            return LibZmq.zmq_connect(handle, Text("tcp://" + authority + "\0")) == 0;
        }

        /// <summary>Connect within this program.</summary>
        public void ConnectInside(string name) { LibZmq.zmq_connect(handle, Text("inproc://" + name + "\0")); }

        public void BindInside(string name) { LibZmq.zmq_bind(handle, Text("inproc://" + name + "\0")); }

        /// <summary>Follow the connection, before it is made.</summary>
        public void Watch()
        {
            string name = "iris-session-" + Interlocked.Increment(ref monitors);
            const int events = LibZmq.Connected | LibZmq.Retried | LibZmq.Disconnected | LibZmq.HandshakeFailed | LibZmq.KeyRefused;
            LibZmq.zmq_socket_monitor(handle, Text("inproc://" + name + "\0"), events);
            monitor = new LibZmqSocket(context, LibZmq.Pair);
            monitor.ConnectInside(name);
        }

        /// <summary>Take what happened to the connection since the last call. Once lost it stays so, though libzmq connects again.</summary>
        public ZmqLink TakeLink()
        {
            while (monitor != null && monitor.TryReceive(happened))
            {
                int at = happened.OffsetOf(0);
                int what = happened.Buffer[at] | happened.Buffer[at + 1] << 8;
                if (Link == ZmqLink.Opening || Link == ZmqLink.Open) Link = what == LibZmq.Connected ? ZmqLink.Open : what == LibZmq.KeyRefused ? ZmqLink.Refused : ZmqLink.Lost;
            }
            return Link;
        }

        /// <summary>Send a frame. False: the queue is full, or the socket is closed.</summary>
        public bool TrySend(byte[] bytes, int count, bool hasMore = false)
        {
            return LibZmq.zmq_send(handle, bytes, (UIntPtr)count, LibZmq.DontWait | (hasMore ? LibZmq.SendMore : 0)) >= 0;
        }

        /// <summary>Take a message. False: there is none. Of one with too many frames the first are taken.</summary>
        public bool TryReceive(Multipart message)
        {
            message.Clear();
            int end = 0;
            for (bool hasMore = true; hasMore;)
            {
                LibZmq.zmq_msg_init(frame);
                bool isThere = LibZmq.zmq_msg_recv(frame, handle, LibZmq.DontWait) >= 0;
                int size = isThere ? (int)LibZmq.zmq_msg_size(frame) : 0;
                hasMore = isThere && LibZmq.zmq_msg_more(frame) != 0;
                if (isThere && message.Count < Multipart.MaxFrames)
                {
                    if (message.Buffer.Length < end + size) Array.Resize(ref message.Buffer, Math.Max(2 * message.Buffer.Length, end + size));
                    if (size > 0) Marshal.Copy(LibZmq.zmq_msg_data(frame), message.Buffer, end, size);
                    message.Add(end, size);
                    end += size;
                }
                LibZmq.zmq_msg_close(frame);
                if (!isThere) return false; // frames of one message come together
            }
            return true;
        }

        public void Dispose()
        {
            if (handle == IntPtr.Zero) return;
            monitor?.Dispose();
            LibZmq.zmq_close(handle);
            handle = IntPtr.Zero;
            Marshal.FreeHGlobal(frame);
        }

        /// <summary>Wait until one of the sockets, or what became of one's connection, can be taken, or the time is over.</summary>
        public static void Wait(List<LibZmqSocket> sockets, int milliseconds)
        {
            IntPtr items = Marshal.AllocHGlobal(2 * sockets.Count * ItemBytes);
            int count = 0;
            foreach (LibZmqSocket socket in sockets)
            {
                Add(items, ref count, socket);
                if (socket.monitor != null) Add(items, ref count, socket.monitor);
            }
            LibZmq.zmq_poll(items, count, (IntPtr)milliseconds);
            Marshal.FreeHGlobal(items);
        }

        private static void Add(IntPtr items, ref int count, LibZmqSocket socket)
        {
            IntPtr item = items + ItemBytes * count++;
            Marshal.WriteIntPtr(item, socket.handle);
            Marshal.WriteInt16(item, IntPtr.Size + FdBytes, LibZmq.PollIn);
            Marshal.WriteInt16(item, IntPtr.Size + FdBytes + 2, 0);
        }

        private static byte[] Text(string text) { return Encoding.ASCII.GetBytes(text); }
    }
}
