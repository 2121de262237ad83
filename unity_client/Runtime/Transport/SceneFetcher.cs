// The scene of a session with all its assets, fetched and kept on a thread of its own: cache, link, hashes.
//
//     SessionView.SceneHash --> SceneFollower --wanted--> AssetCache, else AssetLoader --> IAssetChannel --> hashed, kept --> SceneFollower
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>What an engine's thread sees of a scene on its way.</summary>
    public sealed class SceneProgress
    {
        public readonly SceneState State;

        /// <summary>Assets that are not here yet, and how many bytes that are, as stated.</summary>
        public readonly int MissingCount;
        public readonly double MissingBytes;

        /// <summary>Assets that could not be had.</summary>
        public readonly int FailedCount;

        /// <summary>Why the scene cannot be had, or why assets wait, for people; else empty.</summary>
        public readonly string Text;

        /// <summary>`Kept`, or why the newest asset was not.</summary>
        public readonly CacheResult Cache;

        internal SceneProgress(SceneFollower follower, AssetLoader loader, AssetCache cache)
        {
            State = follower.State;
            MissingCount = follower.MissingCount;
            MissingBytes = follower.MissingBytes;
            FailedCount = follower.FailedCount;
            Text = follower.Failure.Length > 0 ? follower.Failure : loader.Refusal;
            Cache = cache.State;
        }

        /// <summary>True when everything of the scene is here that can be had.</summary>
        public bool IsComplete { get { return State == SceneState.NotShared || State == SceneState.Unreadable || (State == SceneState.Shown && MissingCount == 0); } }

        internal bool IsSame(SceneProgress other)
        {
            return State == other.State && MissingCount == other.MissingCount && FailedCount == other.FailedCount && Text == other.Text && Cache == other.Cache;
        }
    }

    /// <summary>A plan of the scene, and what differs from the one before.</summary>
    public sealed class SceneUpdate
    {
        /// <summary>Address of its specification, as `SessionView.SceneHash` has it.</summary>
        public readonly string SceneHash;
        public readonly ScenePlan Plan;
        public readonly SceneChanges Changes;

        internal SceneUpdate(string sceneHash, ScenePlan plan, SceneChanges changes)
        {
            SceneHash = sceneHash;
            Plan = plan;
            Changes = changes;
        }
    }

    /// <summary>Fetches the scene of a client. Start it after the client, stop it before.</summary>
    public sealed class SceneFetcher : ISceneAssets
    {
        /// <summary>Pause while nothing is on its way [ms].</summary>
        private const int IdleMs = 20;

        private readonly SessionClient client;
        private readonly AssetCache cache; // guarded by itself, as other fetchers may have it; held while files are read, written and hashed
        private readonly SceneFollower follower;
        private readonly AssetLoader loader = new AssetLoader();
        private readonly Dictionary<string, byte[]> ready = new Dictionary<string, byte[]>(); // guarded by itself; held for moments
        private readonly Dictionary<string, GrowingBytes> parts = new Dictionary<string, GrowingBytes>();
        private readonly Queue<string> lookups = new Queue<string>();
        private readonly List<SceneAsset> wanted = new List<SceneAsset>();
        private readonly List<string> names = new List<string>();
        private readonly List<ChunkRequest> requests = new List<ChunkRequest>();
        private readonly AssetAnswer answer = new AssetAnswer();
        private readonly Thread thread;
        private readonly AutoResetEvent wake = new AutoResetEvent(false);
        private volatile bool isStopping;
        private volatile bool isReleasing;
        private volatile IAssetChannel channel;
        private volatile SceneProgress progress;
        private volatile string crash = "";
        private SceneUpdate update; // handed over
        private int pending; // requests that wait for an answer

        /// <param name="client">Its session.</param>
        /// <param name="cache">Assets that are kept. Other users of it lock it.</param>
        /// <param name="budget">What the device can show.</param>
        public SceneFetcher(SessionClient client, AssetCache cache, SceneBudget budget)
        {
            this.client = client;
            this.cache = cache;
            follower = new SceneFollower(budget);
            progress = new SceneProgress(follower, loader, cache);
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session assets" };
        }

        /// <summary>How far the scene is.</summary>
        public SceneProgress Progress { get { return progress; } }

        /// <summary>Assets that came over the link, and their bytes; and assets that had another hash than their address.</summary>
        public long FetchedCount { get; private set; }

        public long FetchedBytes { get; private set; }

        public long DamagedCount { get; private set; }

        /// <summary>The error that ended the thread, empty while it runs as it should.</summary>
        public string Crash { get { return crash; } }

        public void Start()
        {
            thread.Start();
        }

        /// <summary>End the thread. Returns within a second: whether it has ended.</summary>
        public bool Stop()
        {
            isStopping = true;
            channel?.Abort();
            wake.Set();
            return thread.Join(950);
        }

        /// <summary>Take the newest plan and the changes since the one that was taken before, null for none. Waits for nothing.</summary>
        public SceneUpdate TakeUpdate()
        {
            SceneUpdate taken = Interlocked.Exchange(ref update, null);
            if (taken != null) wake.Set();
            return taken;
        }

        /// <summary>Return the bytes of an asset of the scene, null while it is not here. May read a file: not for the engine's thread.</summary>
        public byte[] Find(string address)
        {
            lock (ready) if (ready.TryGetValue(address, out byte[] bytes)) return bytes;
            lock (cache) return cache.Read(address);
        }

        /// <summary>Let go of the bytes that the cache has too, once all is built: <see cref="Find"/> reads them again from there. Waits for nothing.</summary>
        public void ReleaseBytes()
        {
            isReleasing = true;
            wake.Set();
        }

        /// <summary>Bytes of assets that are held in memory.</summary>
        internal long HeldBytes
        {
            get
            {
                long sum = 0;
                lock (ready) foreach (byte[] bytes in ready.Values) sum += bytes.Length;
                return sum;
            }
        }

        private void Run()
        {
            try
            {
                while (!isStopping)
                {
                    if (isReleasing) ReleaseKept();
                    Follow();
                    LookUp();
                    SendRequests();
                    if (pending > 0) Receive();
                    else if (lookups.Count == 0) wake.WaitOne(IdleMs);
                    Publish();
                }
            }
            catch (Exception error)
            {
                crash = error.ToString(); // a defect of ours: the session goes on without a scene
            }
            finally
            {
                channel?.Dispose();
            }
        }

        private void Follow()
        {
            SessionView view = client.View;
            follower.Follow(view.IsSynced, view.SceneHash, MonotonicClock.NowNs);
            wanted.Clear();
            names.Clear();
            follower.TakeWanted(wanted, names);
            foreach (string address in names)
            {
                loader.Remove(address);
                parts.Remove(address);
            }
            foreach (SceneAsset asset in wanted) loader.Add(asset.Address, asset.Bytes);
        }

        /// <summary>Search one asset in the cache.</summary>
        private void LookUp()
        {
            names.Clear();
            loader.TakeLookups(names);
            foreach (string one in names) lookups.Enqueue(one);
            if (lookups.Count == 0) return;
            string address = lookups.Dequeue();
            byte[] bytes = Find(address);
            if (bytes != null)
            {
                loader.Remove(address);
                OnAsset(address, bytes, bytes.Length);
                return;
            }
            loader.OnMissing(address, 0);
            parts[address] = new GrowingBytes();
        }

        private void SendRequests()
        {
            if (channel != null && !channel.IsCurrent) DropChannel(false);
            long nowNs = MonotonicClock.NowNs;
            if (parts.Count == 0 || loader.IsPaused(nowNs)) return;
            if (channel == null) channel = client.OpenAssets();
            if (channel == null) return;
            if (isStopping) channel.Abort();
            requests.Clear();
            loader.TakeRequests(nowNs, requests);
            foreach (ChunkRequest request in requests)
            {
                if (channel.TryRequest(request))
                {
                    pending++;
                    continue;
                }
                DropChannel(true);
                return;
            }
        }

        private void DropChannel(bool isLost)
        {
            IAssetChannel dropped = channel;
            channel = null;
            dropped.Dispose();
            pending = 0;
            if (isLost) loader.OnLinkLost(MonotonicClock.NowNs);
            else loader.OnLinkClosed();
        }

        private void Receive()
        {
            if (!channel.TryReceive(answer))
            {
                DropChannel(true);
                return;
            }
            pending--;
            long nowNs = MonotonicClock.NowNs;
            ChunkRequest request = answer.Request;
            if (answer.Reason.Length > 0)
            {
                AssetOutcome refused = loader.ProcessRefusal(request.RequestId, answer.Reason, answer.Advice, nowNs, out string address);
                if (refused == AssetOutcome.Failed) Fail(address, loader.FailureText);
                else if (refused == AssetOutcome.Restart) StartAgain(address);
                return;
            }
            AssetOutcome outcome = loader.ProcessChunk(request.RequestId, request.Address, answer.Offset, answer.Total, answer.Count, nowNs);
            if (outcome == AssetOutcome.Failed) Fail(request.Address, loader.FailureText);
            else if (outcome == AssetOutcome.Unasked) Fail(request.Address, "another part of asset " + request.Address + " came than was requested");
            else if (outcome == AssetOutcome.Store) Store(request.Address);
        }

        private void Store(string address)
        {
            loader.OnStored(answer.Count);
            if (!parts.TryGetValue(address, out GrowingBytes part)) return;
            part.Append(answer.Bytes, answer.Count);
            if (!loader.IsComplete(address)) return;
            CacheResult kept;
            lock (cache) kept = cache.Store(address, part.Bytes, 0, part.Count);
            if (kept == CacheResult.Damaged)
            {
                DamagedCount++;
                if (loader.RestartAsset(address)) parts[address] = new GrowingBytes();
                else Fail(address, "the bytes of asset " + address + " have another hash, twice");
                return;
            }
            FetchedCount++;
            FetchedBytes += part.Count;
            loader.Remove(address);
            parts.Remove(address);
            OnAsset(address, part.ToArray(), part.Count);
        }

        private void StartAgain(string address)
        {
            parts[address] = new GrowingBytes();
            loader.OnMissing(address, 0);
        }

        private void Fail(string address, string text)
        {
            loader.Remove(address);
            parts.Remove(address);
            follower.OnFailed(address, text, MonotonicClock.NowNs);
        }

        private void OnAsset(string address, byte[] bytes, int count)
        {
            ScenePlan before = follower.Plan;
            follower.OnAsset(address, bytes, 0, count);
            bool isPlan = follower.Plan != before; // that was the specification
            if (isPlan) lock (cache) cache.Pin(follower.Plan.Assets);
            lock (ready)
            {
                if (isPlan) ready.Clear();
                else ready[address] = bytes;
            }
        }

        private void ReleaseKept()
        {
            isReleasing = false;
            List<string> held;
            lock (ready) held = new List<string>(ready.Keys);
            lock (cache) held.RemoveAll(address => !cache.Contains(address));
            lock (ready) foreach (string address in held) ready.Remove(address);
        }

        private void Publish()
        {
            SceneProgress now = new SceneProgress(follower, loader, cache);
            if (!now.IsSame(progress))
            {
                progress = now;
                client.NoteScene(new SceneFacts(follower, cache.State));
            }
            if (Volatile.Read(ref update) != null) return;
            SceneChanges next = follower.TakeChanges();
            if (next != null) Volatile.Write(ref update, new SceneUpdate(follower.PlanHash, follower.Plan, next));
        }
    }

    /// <summary>Bytes that come in parts. Grows with what came, not with what was stated.</summary>
    internal sealed class GrowingBytes
    {
        public byte[] Bytes = new byte[0];

        public int Count { get; private set; }

        public void Append(byte[] bytes, int count)
        {
            if (Bytes.Length < Count + count) Array.Resize(ref Bytes, (int)Math.Min(int.MaxValue / 2, Math.Max(Count + (long)count, 2L * Bytes.Length)));
            Buffer.BlockCopy(bytes, 0, Bytes, Count, count);
            Count += count;
        }

        public byte[] ToArray()
        {
            if (Bytes.Length == Count) return Bytes;
            byte[] exact = new byte[Count];
            Buffer.BlockCopy(Bytes, 0, exact, 0, Count);
            return exact;
        }
    }
}
