// Assets of a session by a DEALER: requests of chunks, answered in their order. docs/protocol.md, assets channel, is normative.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
#if IRIS_NETMQ
using ZmqSocket = IrisSession.Transport.NetMqSocket;
#else
using ZmqSocket = IrisSession.Transport.LibZmqSocket;
#endif

namespace IrisSession.Transport
{
    /// <summary>A connection for assets, for one thread. See <see cref="IAssetChannel"/>.</summary>
    internal sealed class ZmqAssetChannel : IAssetChannel
    {
        /// <summary>Time for an answer: assets come when state, samples and media leave room [ns].</summary>
        private const long AnswerNs = 15_000_000_000;
        private const int SliceMs = 50;

        private readonly ZmqTransport transport;
        private readonly ZmqSocket socket;
        private readonly long connectionEpoch;
        private readonly Queue<ChunkRequest> pending = new Queue<ChunkRequest>();
        private readonly List<ZmqSocket> waited;
        private readonly WireWriter writer = new WireWriter();
        private readonly WireReader reader = new WireReader();
        private readonly Multipart message = new Multipart();
        private volatile bool isLost;

        public ZmqAssetChannel(ZmqTransport transport, ZmqSocket socket, string authority, long connectionEpoch)
        {
            this.transport = transport;
            this.socket = socket;
            this.connectionEpoch = connectionEpoch;
            waited = new List<ZmqSocket> { socket };
            isLost = !socket.TryConnect(authority);
        }

        public bool IsCurrent { get { return !isLost && transport.IsCurrent(connectionEpoch); } }

        public bool TryRequest(ChunkRequest request)
        {
            if (!IsCurrent) return false;
            writer.Clear();
            new AssetRequest
            {
                Version = Wire.Version,
                ConnectionEpoch = connectionEpoch,
                RequestId = request.RequestId,
                Address = request.Address,
                Offset = request.Offset,
                Length = request.Length,
            }.WriteTo(writer);
            isLost |= !socket.TrySend(writer.Data, writer.Length);
            if (!isLost) pending.Enqueue(request);
            return !isLost;
        }

        public bool TryReceive(AssetAnswer answer)
        {
            long untilNs = MonotonicClock.NowNs + AnswerNs;
            while (IsCurrent && pending.Count > 0 && MonotonicClock.NowNs < untilNs)
            {
                if (socket.TryReceive(message)) return Read(answer);
                ZmqSocket.Wait(waited, SliceMs);
            }
            isLost = true;
            return false;
        }

        public void Abort() { isLost = true; }

        public void Dispose()
        {
            isLost = true;
            socket.Dispose();
        }

        private bool Read(AssetAnswer answer)
        {
            answer.Request = pending.Dequeue();
            answer.Reason = answer.Advice = "";
            answer.Count = 0;
            try
            {
                reader.Reset(message.Buffer, message.OffsetOf(0), message.LengthOf(0));
                if (message.Count == 1)
                {
                    AssetRefused refused = AssetRefused.Read(reader);
                    isLost |= refused.RequestId != answer.Request.RequestId;
                    answer.Reason = refused.Reason;
                    answer.Advice = refused.Advice;
                    return !isLost;
                }
                AssetChunk chunk = AssetChunk.Read(reader);
                isLost |= chunk.RequestId != answer.Request.RequestId;
                answer.Offset = chunk.Offset;
                answer.Total = chunk.Total;
            }
            catch (WireException)
            {
                isLost = true;
            }
            if (isLost) return false;
            answer.Count = message.LengthOf(1);
            if (answer.Bytes.Length < answer.Count) answer.Bytes = new byte[answer.Count];
            Buffer.BlockCopy(message.Buffer, message.OffsetOf(1), answer.Bytes, 0, answer.Count);
            return true;
        }
    }
}
