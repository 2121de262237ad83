// Order and window of chunk requests for wanted assets. Pure: no socket, disk, clock or thread.
//
//     wanted --TakeLookups--> searched in the cache --OnMissing(offset)--> requested in chunks --complete--> hashed
//        `--Remove (found)                                                              again, Remove <--'
//
// Answers come in the order of the requests, so the bytes of one asset come in order too, and a request whose successor is answered
// was lost with its connection, and is made again. A chunk that does not continue its asset is ignored. A window bounds the bytes that
// were requested and are not stored yet. The chunk size adapts to the speed of the link.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>One request to be sent.</summary>
    public readonly struct ChunkRequest
    {
        public readonly long RequestId;
        public readonly string Address;
        public readonly long Offset;
        public readonly int Length;

        public ChunkRequest(long requestId, string address, long offset, int length)
        {
            RequestId = requestId;
            Address = address;
            Offset = offset;
            Length = length;
        }
    }

    /// <summary>What to do after an answer.</summary>
    public enum AssetOutcome
    {
        /// <summary>Store the bytes, then call `OnStored`.</summary>
        Store,

        /// <summary>The bytes are of no use.</summary>
        Ignored,

        /// <summary>It was not requested.</summary>
        Unasked,

        /// <summary>It is requested again after a pause.</summary>
        Later,

        /// <summary>Remove what is stored of the asset, then call `OnMissing` with 0.</summary>
        Restart,

        /// <summary>The asset cannot be fetched: `FailureReason` and `FailureText` say why.</summary>
        Failed,
    }

    /// <summary>Scheduler of chunk requests. All `nowNs` are of one monotonic clock.</summary>
    public sealed class AssetLoader
    {
        /// <summary>Most bytes of an asset: of one that is stated to have more, nothing is fetched.</summary>
        public const long MaxAssetBytes = (1L << 30) + (1L << 20);

        private const int MaxRequests = 32;
        private const int FirstChunkBytes = 512 << 10;

        /// <summary>Chunks double when one takes less than `FastNs`, and halve when it takes longer than `SlowNs`.</summary>
        private const int MinChunkBytes = 64 << 10;
        private const int MaxChunkBytes = 1 << 20;
        private const long FastNs = 100_000_000;
        private const long SlowNs = 2_000_000_000;

        /// <summary>Window [bytes]: enough for 400 Mbit/s and 100 ms.</summary>
        private const long WindowBytes = 6 << 20;

        /// <summary>Assets in progress at once: small ones must not wait for each other's round trips.</summary>
        private const int AtOnce = 32;

        /// <summary>Pauses after a temporary refusal and after a disconnect; doubled each time, until a chunk comes.</summary>
        private const long FirstPauseNs = 50_000_000;
        private const long LongestPauseNs = 2_000_000_000;

        /// <summary>One asset. `Got`: bytes that came; `Asked`: bytes that came or were asked for; `Total` -1: not known yet.</summary>
        private sealed class Item
        {
            public string Address;
            public long Got;
            public long Asked;
            public long Total = -1;
            public long SizeHint;
            public bool IsAgain;

            /// <summary>True when there is more to request now: of an unknown size only a first chunk.</summary>
            public bool IsOpen { get { return Total < 0 ? Asked == Got : Asked < Total; } }

            public int NextBytes(int most)
            {
                if (Total >= 0) return (int)Math.Min(most, Total - Asked);
                return SizeHint > Asked ? (int)Math.Min(most, SizeHint - Asked) : most;
            }
        }

        private struct Ask
        {
            public ChunkRequest Request;
            public long AtNs;
        }

        private readonly Queue<KeyValuePair<string, long>> wantedOrder = new Queue<KeyValuePair<string, long>>();
        private readonly HashSet<string> wanted = new HashSet<string>(); // not looked up yet
        private readonly Dictionary<string, long> busy = new Dictionary<string, long>(); // looked up, or removed to start again
        private readonly List<Item> items = new List<Item>(); // missing bytes, in the order of the assets
        private readonly HashSet<string> again = new HashSet<string>(); // removed once because the session has fewer bytes
        private readonly List<Ask> asked = new List<Ask>(); // in the order of their numbers
        private int chunkBytes = FirstChunkBytes;
        private long unstored;
        private long nextId;
        private long pauseNs;

        /// <summary>Reason for which the session postpones requests, in its words; empty while bytes come.</summary>
        public string Refusal { get; private set; } = "";

        /// <summary>Of the last asset that failed: an `AssetRefusal`, or `protocol`; and words for people.</summary>
        public string FailureReason { get; private set; } = "";

        public string FailureText { get; private set; } = "";

        /// <summary>Time at which requests go on after a pause.</summary>
        public long PausedUntilNs { get; private set; }

        /// <summary>True when nothing is wanted.</summary>
        public bool IsIdle { get { return wanted.Count == 0 && busy.Count == 0 && items.Count == 0; } }

        /// <summary>Add an asset at the end of the order; `size` [bytes] if it is known, else -1. False when it is in progress already.</summary>
        public bool Add(string address, long size = -1)
        {
            if (busy.ContainsKey(address) || Find(address) != null || !wanted.Add(address)) return false;
            wantedOrder.Enqueue(new KeyValuePair<string, long>(address, size));
            return true;
        }

        /// <summary>Append assets to be looked up in the cache now.</summary>
        public void TakeLookups(List<string> lookups)
        {
            while (wantedOrder.Count > 0 && busy.Count + items.Count < AtOnce)
            {
                KeyValuePair<string, long> next = wantedOrder.Dequeue();
                if (!wanted.Remove(next.Key)) continue; // removed meanwhile
                busy[next.Key] = next.Value;
                lookups.Add(next.Key);
            }
        }

        /// <summary>Note that an asset is not in the cache, but its first `offset` bytes are.</summary>
        public void OnMissing(string address, long offset)
        {
            if (!busy.TryGetValue(address, out long size)) return;
            busy.Remove(address);
            items.Add(new Item { Address = address, Got = offset, Asked = offset, SizeHint = size, IsAgain = again.Contains(address) });
        }

        /// <summary>Start an asset again whose bytes had another hash. Returns false when that was the second time: it is removed.</summary>
        public bool RestartAsset(string address)
        {
            Item item = Find(address);
            if (item == null) return true;
            if (item.IsAgain)
            {
                Remove(address);
                return false;
            }
            items[items.IndexOf(item)] = new Item { Address = address, SizeHint = -1, IsAgain = true };
            return true;
        }

        /// <summary>Remove an asset that is complete, failed or wanted no more.</summary>
        public void Remove(string address)
        {
            wanted.Remove(address);
            busy.Remove(address);
            again.Remove(address);
            Item item = Find(address);
            if (item != null) items.Remove(item);
        }

        /// <summary>Append requests to send now, in the order of the assets. They count as sent.</summary>
        public void TakeRequests(long nowNs, List<ChunkRequest> requests)
        {
            if (IsPaused(nowNs)) return;
            foreach (Item item in items)
            {
                while (item.IsOpen)
                {
                    int length = item.NextBytes(chunkBytes);
                    if (asked.Count >= MaxRequests || CountOutstanding() + length > WindowBytes) return;
                    ChunkRequest request = new ChunkRequest(++nextId, item.Address, item.Asked, length);
                    asked.Add(new Ask { Request = request, AtNs = nowNs });
                    item.Asked += length;
                    requests.Add(request);
                }
            }
        }

        /// <summary>Process a chunk of `size` bytes from `offset` on, of an asset of `total`.</summary>
        public AssetOutcome ProcessChunk(long requestId, string address, long offset, long total, int size, long nowNs)
        {
            if (!TakeAsk(requestId, out Ask ask) || ask.Request.Offset != offset || ask.Request.Address != address) return AssetOutcome.Unasked;
            RestoreLostRequests(requestId);
            pauseNs = 0;
            Refusal = "";
            AdaptChunkSize(ask.Request, size, nowNs - ask.AtNs);
            Item item = Find(address);
            if (item == null || offset != item.Got) return AssetOutcome.Ignored;
            long expected = Math.Min(ask.Request.Length, total - offset);
            if ((item.Total != -1 && item.Total != total) || size > ask.Request.Length || size > expected || (size == 0 && expected != 0))
            {
                return Fail(address, "protocol", "the session contradicts itself about asset " + address);
            }
            if (total > MaxAssetBytes) return Fail(address, "protocol", "asset " + address + " has " + total + " bytes: at most " + MaxAssetBytes + " are fetched");
            item.Total = total;
            item.Got += size;
            if (size < expected) item.Asked = item.Got;
            item.Asked = Math.Max(item.Got, Math.Min(item.Asked, item.Total));
            unstored += size;
            return AssetOutcome.Store;
        }

        /// <summary>Return whether all bytes of an asset came.</summary>
        public bool IsComplete(string address)
        {
            Item item = Find(address);
            return item != null && item.Got == item.Total;
        }

        /// <summary>Note that bytes are in the cache, or dropped: they leave the window.</summary>
        public void OnStored(int size)
        {
            unstored -= size;
        }

        /// <summary>Process a refusal of a request.</summary>
        public AssetOutcome ProcessRefusal(long requestId, string reason, string advice, long nowNs, out string address)
        {
            address = "";
            if (!TakeAsk(requestId, out Ask ask)) return AssetOutcome.Unasked;
            address = ask.Request.Address;
            RestoreLostRequests(requestId);
            Item item = Find(address);
            if (item == null) return AssetOutcome.Ignored;
            if (reason == AssetRefusal.TooMany || reason == AssetRefusal.NotAllowed || reason == AssetRefusal.Rate || reason == AssetRefusal.Busy)
            {
                Refusal = reason + ": " + advice;
                Pause(nowNs, pauseNs);
                TakeBack(ask.Request);
                return AssetOutcome.Later;
            }
            bool startsAgain = reason == AssetRefusal.BadRange && item.Got > 0 && !item.IsAgain;
            if (!startsAgain) return Fail(address, reason, "asset " + address + " was refused (" + reason + "): " + advice);
            Remove(address);
            busy[address] = -1; // more bytes are stored than the asset has: they belong to another one
            again.Add(address);
            return AssetOutcome.Restart;
        }

        /// <summary>Return whether nothing is to be requested now.</summary>
        public bool IsPaused(long nowNs)
        {
            return nowNs < PausedUntilNs;
        }

        /// <summary>Note that the connection ended, but not by us: the next one is made after a pause.</summary>
        public void OnLinkLost(long nowNs)
        {
            long before = pauseNs;
            OnLinkClosed();
            Pause(nowNs, before);
        }

        /// <summary>Note that we closed the connection: pending requests are lost, received bytes stay.</summary>
        public void OnLinkClosed()
        {
            asked.Clear();
            pauseNs = PausedUntilNs = 0;
            foreach (Item item in items) item.Asked = item.Got;
        }

        private Item Find(string address)
        {
            foreach (Item item in items) if (item.Address == address) return item;
            return null;
        }

        private long CountOutstanding()
        {
            long bytes = unstored;
            foreach (Ask ask in asked) bytes += ask.Request.Length;
            return bytes;
        }

        private bool TakeAsk(long requestId, out Ask ask)
        {
            for (int i = 0; i < asked.Count; i++)
            {
                if (asked[i].Request.RequestId != requestId) continue;
                ask = asked[i];
                asked.RemoveAt(i);
                return true;
            }
            ask = default;
            return false;
        }

        /// <summary>Request again what was requested before `requestId`: after this answer those will not be answered.</summary>
        private void RestoreLostRequests(long requestId)
        {
            while (asked.Count > 0 && asked[0].Request.RequestId < requestId)
            {
                TakeBack(asked[0].Request);
                asked.RemoveAt(0);
            }
        }

        private void TakeBack(ChunkRequest request)
        {
            Item item = Find(request.Address);
            if (item != null) item.Asked = Math.Max(item.Got, Math.Min(item.Asked, request.Offset));
        }

        /// <summary>Use larger chunks on a fast link, smaller ones on a slow one, by the times of whole chunks.</summary>
        private void AdaptChunkSize(ChunkRequest request, int size, long tookNs)
        {
            if (size != chunkBytes || size != request.Length) return;
            if (tookNs < FastNs) chunkBytes = Math.Min(2 * size, MaxChunkBytes);
            else if (tookNs > SlowNs) chunkBytes = Math.Max(size >> 1, MinChunkBytes);
        }

        private void Pause(long nowNs, long before)
        {
            pauseNs = Math.Min(Math.Max(FirstPauseNs, 2 * before), LongestPauseNs);
            PausedUntilNs = nowNs + pauseNs;
        }

        private AssetOutcome Fail(string address, string reason, string text)
        {
            Remove(address);
            FailureReason = reason;
            FailureText = text;
            return AssetOutcome.Failed;
        }
    }
}
