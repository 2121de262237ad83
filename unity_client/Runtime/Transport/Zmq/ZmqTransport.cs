// The channels of a session by ZeroMQ, without a gateway: for PCs on its network. docs/protocol.md, sections 2, 4 and 8, is normative;
// settings of sockets as iris_session/client/sockets.py. All sockets but those of assets belong to the thread of the session.
using System;
using System.Collections.Generic;
using System.Text;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
#if IRIS_NETMQ
using ZmqSocket = IrisSession.Transport.NetMqSocket;
#else
using ZmqSocket = IrisSession.Transport.LibZmqSocket;
#endif

namespace IrisSession.Transport
{
    /// <summary>Sockets to a session. Addresses are those of its control channel. See <see cref="ITransport"/>.</summary>
    public sealed class ZmqTransport : ITransport
    {
        private const int MaxStreams = 16;

        /// <summary>Small on purpose: after a stall a client receives only so many old messages, not those of seconds.</summary>
        private const int StateMark = 2;
        private const int StateBytes = 16 << 10;
        private const int ControlMark = 64;
        private const int MostEvents = 1024;
        private const int MediaMark = 2;
        private const int MediaBytes = 128 << 10;

        /// <summary>A last bye has this time to be sent, and all sockets to end [ms].</summary>
        internal const int LingerMs = 200;
        private const int DisposeMs = 800;

        private static readonly byte[] Wakening = new byte[1];
        private readonly IntPtr context = ZmqSocket.OpenContext();
        private readonly ZmqKeys keys;
        private readonly object gate = new object(); // guards the waking socket, and what channels of assets read
        private readonly ZmqSocket waking;
        private readonly ZmqSocket woken;
        private readonly List<ZmqSocket> open = new List<ZmqSocket>();
        private readonly NewestMessages states = new NewestMessages(4, false);
        private readonly NewestMessages frames = new NewestMessages(MaxStreams, true);
        private readonly HashSet<string> subscribed = new HashSet<string>();
        private readonly List<string> wishes = new List<string>();
        private Multipart received = new Multipart();
        private WebEndpoint endpoint;
        private Welcome welcome;
        private ZmqSocket control;
        private ZmqSocket state;
        private ZmqSocket media;
        private WebEndpoint probed;
        private long mediaEpoch;
        private bool isDisposed;
        private bool lacksKeys; // the newest endpoint wants some

        /// <param name="keys">Null: a session on loopback, which is not encrypted.</param>
        /// <exception cref="DllNotFoundException">libzmq is not there.</exception>
        /// <exception cref="ArgumentException">libzmq does not take the keys.</exception>
        public ZmqTransport(ZmqKeys keys)
        {
            this.keys = keys;
            new ZmqSocket(context, LibZmq.Dealer, keys).Dispose();
            woken = new ZmqSocket(context, LibZmq.Pull);
            waking = new ZmqSocket(context, LibZmq.Push);
            woken.BindInside("wake");
            waking.ConnectInside("wake");
        }

        public TransportCounters Counters { get; } = new TransportCounters();

        public TransportState State
        {
            get
            {
                if (control == null) return TransportState.Closed;
                return control.Link == ZmqLink.Open ? TransportState.Open : control.Link == ZmqLink.Opening ? TransportState.Opening : TransportState.Closed;
            }
        }

        public LinkEnd End
        {
            get
            {
                if (lacksKeys) return new LinkEnd(LinkFailure.Closed, CloseCode.NotAllowed, "this session is encrypted, and this app has no keys for it: nothing was sent");
                if (control != null && control.Link == ZmqLink.Refused) return new LinkEnd(LinkFailure.Closed, CloseCode.NotAllowed, "the session does not know the key of this app: add it to its keys");
                if (control != null && control.Link == ZmqLink.Clear) return new LinkEnd(LinkFailure.Closed, CloseCode.NotAllowed, "what answers at " + endpoint.Authority + " does not encrypt: another machine may pretend to be the session, nothing was sent to it");
                return control != null && control.Link == ZmqLink.Lost ? new LinkEnd(LinkFailure.Unreachable, 0, "no session answers at " + endpoint.Authority) : default;
            }
        }

        /// <summary>Channels without a gateway need none; this is the number of the connection.</summary>
        public string Ticket { get { return welcome == null ? "" : welcome.ConnectionEpoch.ToString(); } }

        public void Open(WebEndpoint endpoint)
        {
            Close();
            Counters.Opened++;
            lock (gate) this.endpoint = endpoint;
            lacksKeys = keys == null && endpoint.IsSecure;
            if (lacksKeys) return;
            control = new ZmqSocket(context, LibZmq.Dealer, keys);
            control.Set(LibZmq.SendMark, ControlMark);
            control.Set(LibZmq.ReceiveMark, MostEvents);
            control.Set(LibZmq.Linger, LingerMs);
            control.Watch();
            Connect(control, endpoint.Port);
        }

        public void Close()
        {
            CloseMedia();
            Drop(ref state);
            Drop(ref control);
            lock (gate) welcome = null;
            mediaEpoch = 0;
            states.Clear();
        }

        public bool TrySend(byte[] bytes, int count)
        {
            return State == TransportState.Open && control.TrySend(bytes, count);
        }

        public bool TryTakeControl(ref Multipart message)
        {
            if (control == null) return false;
            if (!control.TryReceive(message))
            {
                control.TakeLink(); // after the last messages before an end
                return false;
            }
            if (welcome == null) TakeWelcome(message);
            return true;
        }

        public bool TryTakeState(ref Multipart message)
        {
            bool came = Take(state, states, ref message);
            Counters.StateSuperseded = states.Superseded;
            return came;
        }

        public bool TryTakeMedia(ref Multipart message)
        {
            bool came = Take(media, frames, ref message);
            Counters.MediaSuperseded = frames.Superseded;
            return came;
        }

        /// <summary>There is no gateway.</summary>
        public string TakeNotice() { return null; }

        public void SetMedia(IReadOnlyList<string> streams, long connectionEpoch)
        {
            if (connectionEpoch != mediaEpoch) CloseMedia(); // topics are those of a connection
            mediaEpoch = connectionEpoch;
            int count = Math.Min(streams.Count, MaxStreams);
            bool isSame = count == wishes.Count;
            for (int i = 0; i < count && isSame; i++) isSame = streams[i] == wishes[i];
            if (isSame || mediaEpoch == 0 || welcome == null || welcome.Endpoints.Media == 0) return;
            wishes.Clear();
            for (int i = 0; i < count; i++) wishes.Add(streams[i]);
            if (media == null) OpenMedia();
            foreach (string one in wishes) if (subscribed.Add(one)) media.Set(LibZmq.Subscribe, MakeTopic(one));
            subscribed.RemoveWhere(one =>
            {
                if (wishes.Contains(one)) return false;
                media.Set(LibZmq.Unsubscribe, MakeTopic(one));
                return true;
            });
        }

        public IAssetChannel OpenAssets()
        {
            lock (gate)
            {
                if (welcome == null || welcome.Endpoints.Assets == 0 || isDisposed) return null;
                return new ZmqAssetChannel(this, new ZmqSocket(context, LibZmq.Dealer, keys), MakeAuthority(welcome.Endpoints.Assets), welcome.ConnectionEpoch);
            }
        }

        /// <summary>Return whether a connection is the present one. For any thread.</summary>
        internal bool IsCurrent(long connectionEpoch)
        {
            lock (gate) return welcome != null && welcome.ConnectionEpoch == connectionEpoch;
        }

        /// <summary>Other addresses are not tried: a session has one control channel.</summary>
        public void StartProbe(WebEndpoint endpoint) { probed = endpoint; }

        public bool TryTakeProbe(out ProbeAnswer answer)
        {
            answer = new ProbeAnswer(probed, new LinkEnd(LinkFailure.Unreachable, 0, "not tried"), "");
            bool wasProbed = probed != null;
            probed = null;
            return wasProbed;
        }

        public long Tick(long nowNs) { return long.MaxValue; }

        public void Wait(int milliseconds)
        {
            open.Clear();
            open.Add(woken);
            if (control != null) open.Add(control);
            if (state != null) open.Add(state);
            if (media != null) open.Add(media);
            ZmqSocket.Wait(open, milliseconds);
            while (woken.TryReceive(received)) { }
        }

        public void Wake()
        {
            lock (gate) if (!isDisposed) waking.TrySend(Wakening, 1);
        }

        /// <summary>Close everything. Returns within a second, also while a channel of assets is open: its waits end.</summary>
        public void Dispose()
        {
            Close();
            lock (gate)
            {
                if (isDisposed) return;
                isDisposed = true;
            }
            waking.Dispose();
            woken.Dispose();
            Thread ending = new Thread(() => ZmqSocket.CloseContext(context)) { IsBackground = true, Name = "iris-session ZeroMQ" };
            ending.Start();
            ending.Join(DisposeMs);
        }

        private static void Drop(ref ZmqSocket socket)
        {
            socket?.Dispose();
            socket = null;
        }

        private bool Take(ZmqSocket socket, NewestMessages newest, ref Multipart message)
        {
            while (socket != null && socket.TryReceive(received)) newest.Put(ref received);
            return newest.TryTake(ref message);
        }

        /// <summary>The welcome says where the other channels are. What is no message is counted by the connection.</summary>
        private void TakeWelcome(Multipart message)
        {
            try
            {
                WireReader reader = new WireReader();
                reader.Reset(message.Buffer, message.OffsetOf(0), message.LengthOf(0));
                if (!(ServerEnvelope.Read(reader).Message is Welcome found)) return;
                lock (gate) welcome = found;
            }
            catch (WireException)
            {
                return;
            }
            if (welcome.Endpoints.State == 0) return;
            state = new ZmqSocket(context, LibZmq.Sub, keys);
            state.Set(LibZmq.ReceiveMark, StateMark);
            state.Set(LibZmq.ReceiveBuffer, StateBytes);
            state.Set(LibZmq.Subscribe, Encoding.ASCII.GetBytes("rigid"));
            state.Set(LibZmq.Subscribe, Encoding.ASCII.GetBytes("presence"));
            Connect(state, welcome.Endpoints.State);
        }

        private void OpenMedia()
        {
            Counters.MediaOpened++;
            media = new ZmqSocket(context, LibZmq.Sub, keys);
            media.Set(LibZmq.ReceiveMark, MediaMark);
            media.Set(LibZmq.ReceiveBuffer, MediaBytes);
            Connect(media, welcome.Endpoints.Media);
        }

        private void CloseMedia()
        {
            Drop(ref media);
            subscribed.Clear();
            wishes.Clear();
            frames.Clear();
        }

        private byte[] MakeTopic(string stream) { return Encoding.UTF8.GetBytes("media/" + mediaEpoch + "/" + stream + "/"); }

        private void Connect(ZmqSocket socket, long port) { socket.TryConnect(MakeAuthority(port)); }

        private string MakeAuthority(long port) { return new WebEndpoint(endpoint.IsSecure, endpoint.Host, (int)port).Authority; }
    }
}
