// Functions of libzmq 4.3, the native library, by P/Invoke. A project brings it as a plug-in; nothing here is called otherwise.
using System;
using System.Runtime.InteropServices;

namespace IrisSession.Transport
{
    internal static class LibZmq
    {
        internal const string Library = "libzmq";

        // Kinds of sockets.
        public const int Pair = 0, Sub = 2, Dealer = 5, Pull = 7, Push = 8;

        // Options of sockets.
        public const int Subscribe = 6, Unsubscribe = 7, ReceiveBuffer = 12, Linger = 17, MaxMessageBytes = 22, SendMark = 23, ReceiveMark = 24;
        public const int KeepAlive = 34, KeepAliveCount = 35, KeepAliveIdle = 36, KeepAliveInterval = 37, Ipv6 = 42;
        public const int CurvePublicKey = 48, CurveSecretKey = 49, CurveServerKey = 50;

        public const int DontWait = 1, SendMore = 2;
        public const short PollIn = 1;

        // Events of monitors: of a connection that is made and encrypted, and of those that are not.
        public const int Connected = 0x1000, Retried = 0x0004, Disconnected = 0x0200, HandshakeFailed = 0x0800 | 0x2000, KeyRefused = 0x4000;

        /// <summary>Bytes of a `zmq_msg_t`.</summary>
        public const int MessageBytes = 64;

        [DllImport(Library)]
        public static extern IntPtr zmq_ctx_new();

        [DllImport(Library)]
        public static extern int zmq_ctx_term(IntPtr context);

        [DllImport(Library)]
        public static extern IntPtr zmq_socket(IntPtr context, int kind);

        [DllImport(Library)]
        public static extern int zmq_close(IntPtr socket);

        [DllImport(Library)]
        public static extern int zmq_setsockopt(IntPtr socket, int option, byte[] value, UIntPtr length);

        [DllImport(Library)]
        public static extern int zmq_setsockopt(IntPtr socket, int option, ref int value, UIntPtr length);

        [DllImport(Library)]
        public static extern int zmq_setsockopt(IntPtr socket, int option, ref long value, UIntPtr length);

        [DllImport(Library)]
        public static extern int zmq_bind(IntPtr socket, byte[] address);

        [DllImport(Library)]
        public static extern int zmq_connect(IntPtr socket, byte[] address);

        [DllImport(Library)]
        public static extern int zmq_socket_monitor(IntPtr socket, byte[] address, int events);

        [DllImport(Library)]
        public static extern int zmq_send(IntPtr socket, byte[] bytes, UIntPtr length, int flags);

        [DllImport(Library)]
        public static extern int zmq_msg_init(IntPtr message);

        [DllImport(Library)]
        public static extern int zmq_msg_recv(IntPtr message, IntPtr socket, int flags);

        [DllImport(Library)]
        public static extern IntPtr zmq_msg_data(IntPtr message);

        [DllImport(Library)]
        public static extern UIntPtr zmq_msg_size(IntPtr message);

        [DllImport(Library)]
        public static extern int zmq_msg_more(IntPtr message);

        [DllImport(Library)]
        public static extern int zmq_msg_close(IntPtr message);

        [DllImport(Library)]
        public static extern int zmq_poll(IntPtr items, int count, IntPtr milliseconds);
    }
}
