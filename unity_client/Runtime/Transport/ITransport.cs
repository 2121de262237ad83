// What a session loop needs of sockets. The web wire (WebTransport), ZeroMQ (ZmqTransport) and tests implement it.
//
// Sockets run on threads of their own. Nothing here waits for one, but `Wait`, and `Dispose` for a bounded time. Every queue is bounded,
// and what is dropped is counted.
using System;
using System.Collections.Generic;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Where the control channel is.</summary>
    public enum TransportState
    {
        Closed,
        Opening,
        Open,
    }

    /// <summary>Counters of a transport, over all its connections.</summary>
    public sealed class TransportCounters
    {
        /// <summary>Sockets of the control channel that were opened, and those of media.</summary>
        public long Opened;
        public long MediaOpened;

        /// <summary>State that a newer message of its topic replaced before it was taken.</summary>
        public long StateSuperseded;

        /// <summary>Media frames that a newer one of their stream replaced before they were taken, or of too many streams.</summary>
        public long MediaSuperseded;

        /// <summary>Connections that we closed because their control messages were not taken.</summary>
        public long ControlOverflows;

        /// <summary>Notices of the gateway that a newer one replaced.</summary>
        public long NoticesDropped;
        public long Malformed;
    }

    /// <summary>Answer to a probe: whether a gateway answers there, and of which session.</summary>
    public readonly struct ProbeAnswer
    {
        public readonly WebEndpoint Endpoint;

        /// <summary>How it failed; `LinkFailure.None`: it answered.</summary>
        public readonly LinkEnd End;
        public readonly string SessionId;

        public ProbeAnswer(WebEndpoint endpoint, LinkEnd end, string sessionId)
        {
            Endpoint = endpoint;
            End = end;
            SessionId = sessionId;
        }
    }

    /// <summary>Answer to a request for a chunk. Made once and filled again.</summary>
    public sealed class AssetAnswer
    {
        /// <summary>The request that it answers: they are answered in order.</summary>
        public ChunkRequest Request;

        /// <summary>An `AssetRefusal`, empty for bytes; and words for people.</summary>
        public string Reason = "";
        public string Advice = "";

        /// <summary>Place of the bytes, and size of the whole asset.</summary>
        public long Offset;
        public long Total;

        /// <summary>The first `Count` count.</summary>
        public byte[] Bytes = new byte[0];
        public int Count;
    }

    /// <summary>A connection for assets. Its calls wait for sockets, so they are for a thread of their own; `Abort` is for any.</summary>
    public interface IAssetChannel : IDisposable
    {
        /// <summary>False when the connection has moved to another address or ended: open another channel.</summary>
        bool IsCurrent { get; }

        /// <summary>Send a request. False: the connection is lost, with all pending ones.</summary>
        bool TryRequest(ChunkRequest request);

        /// <summary>Wait for the next answer. False: the connection is lost.</summary>
        bool TryReceive(AssetAnswer answer);

        /// <summary>End all waits.</summary>
        void Abort();
    }

    /// <summary>Sockets of one client. Calls belong to one thread, but <see cref="Wake"/> and <see cref="OpenAssets"/>.</summary>
    public interface ITransport : IDisposable
    {
        /// <summary>State of the newest control channel.</summary>
        TransportState State { get; }

        /// <summary>How the newest control channel ended, while it is closed.</summary>
        LinkEnd End { get; }

        /// <summary>Ticket for media and assets of this connection, empty while there is none.</summary>
        string Ticket { get; }

        TransportCounters Counters { get; }

        /// <summary>Open a fresh control channel. What was received of the one before and not taken is dropped, and its media end.</summary>
        void Open(WebEndpoint endpoint);

        /// <summary>Close the control channel and media. What waits to be sent still is, if the socket takes it.</summary>
        void Close();

        /// <summary>Queue an envelope to be sent. False: the channel is not open, or its queue is full.</summary>
        bool TrySend(byte[] bytes, int count);

        /// <summary>Take the oldest message of the control channel in exchange for `message`. False: there is none.</summary>
        bool TryTakeControl(ref Multipart message);

        /// <summary>Take the newest state of some topic, in the same way. Call it until there is none.</summary>
        bool TryTakeState(ref Multipart message);

        /// <summary>Take the newest media frame of some stream, in the same way.</summary>
        bool TryTakeMedia(ref Multipart message);

        /// <summary>Take words of the gateway for the person, null for none.</summary>
        string TakeNotice();

        /// <summary>Set the media streams that are wanted, the first 16, of a connection that may have them (epoch 0: none may).</summary>
        void SetMedia(IReadOnlyList<string> streams, long connectionEpoch);

        /// <summary>Return a connection for assets, null while there can be none. Does not wait; for any thread.</summary>
        IAssetChannel OpenAssets();

        /// <summary>Try whether a gateway answers at an endpoint. One probe at a time: others are ignored meanwhile.</summary>
        void StartProbe(WebEndpoint endpoint);

        bool TryTakeProbe(out ProbeAnswer answer);

        /// <summary>Do what depends on time. Returns the time of the next call [ns].</summary>
        long Tick(long nowNs);

        /// <summary>Wait until something came, <see cref="Wake"/> is called, or the time is over.</summary>
        void Wait(int milliseconds);

        /// <summary>End a wait, from any thread.</summary>
        void Wake();
    }
}
