// The scene that the session has now: its specification, the plan of it, and what of its assets is still missing. Pure: bytes of
// assets come from a cache or a link, which others look after.
//
//     mirror names a hash --> specification wanted --OnAsset--> plan, changes; assets wanted --OnAsset--> complete
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>How far a scene is.</summary>
    public enum SceneState
    {
        /// <summary>Not known yet.</summary>
        Unknown,

        /// <summary>The session shares bodies and poses only.</summary>
        NotShared,

        /// <summary>The specification is on its way.</summary>
        Fetching,

        /// <summary>There is a plan; assets may be missing.</summary>
        Shown,

        /// <summary>The specification cannot be read: `Failure` says why.</summary>
        Unreadable,
    }

    /// <summary>Follows the scene of a session. For one thread.</summary>
    public sealed class SceneFollower
    {
        /// <summary>Time until a specification that could not be fetched is requested again: a session may name it before it serves it.</summary>
        private const long RetryNs = 1_000_000_000;
        private const int AddressDigits = 64;

        private readonly SceneBudget budget;
        private readonly Dictionary<string, SceneAsset> missing = new Dictionary<string, SceneAsset>();
        private readonly List<SceneAsset> wanted = new List<SceneAsset>();
        private readonly List<string> dropped = new List<string>();
        private string hash = "";
        private long retryAt = long.MaxValue;
        private ScenePlan before;
        private bool hasChanges;

        public SceneFollower(SceneBudget budget)
        {
            this.budget = budget;
        }

        public SceneState State { get; private set; }

        /// <summary>The newest plan, null before the first. It stays while another scene is fetched.</summary>
        public ScenePlan Plan { get; private set; }

        /// <summary>Address of the specification of the plan, empty before the first.</summary>
        public string PlanHash { get; private set; } = "";

        /// <summary>Why the specification cannot be had, for people; else empty.</summary>
        public string Failure { get; private set; } = "";

        /// <summary>Assets of the plan that could not be had.</summary>
        public int FailedCount { get; private set; }

        /// <summary>Assets that are not here yet, and how many bytes that are, as stated.</summary>
        public int MissingCount { get { return missing.Count; } }

        public double MissingBytes { get; private set; }

        /// <summary>Return whether a text is the address of an asset.</summary>
        public static bool IsAddress(string text)
        {
            if (text.Length != AddressDigits) return false;
            foreach (char c in text) if (!((c >= '0' && c <= '9') || (c >= 'a' && c <= 'f'))) return false;
            return true;
        }

        /// <summary>Follow the scene that the mirror names. Call it whenever the mirror may have changed.</summary>
        public void Follow(SessionMirror mirror, long nowNs)
        {
            Follow(mirror.IsSynced, mirror.SceneHash, nowNs);
        }

        /// <summary>Follow the scene that the session names, as far as it is known.</summary>
        public void Follow(bool isSynced, string sceneHash, long nowNs)
        {
            if (retryAt <= nowNs && State == SceneState.Fetching && hash.Length > 0)
            {
                retryAt = long.MaxValue;
                Want(new SceneAsset(hash, -1, ""));
            }
            if (!isSynced || sceneHash == hash) return;
            DropAll();
            hash = sceneHash;
            Failure = "";
            retryAt = long.MaxValue;
            if (IsAddress(hash))
            {
                State = SceneState.Fetching;
                Want(new SceneAsset(hash, -1, ""));
            }
            else State = hash.Length == 0 ? SceneState.Unknown : SceneState.NotShared; // the hash of a model
        }

        /// <summary>Take the assets that are wanted since the last call, in order, and the addresses that are wanted no more.</summary>
        public void TakeWanted(List<SceneAsset> assets, List<string> cancelled)
        {
            foreach (SceneAsset asset in wanted) if (missing.ContainsKey(asset.Address)) assets.Add(asset);
            cancelled.AddRange(dropped);
            wanted.Clear();
            dropped.Clear();
        }

        /// <summary>An asset is here. Its bytes were hashed: they are what the address names. Of the specification they are read.</summary>
        public void OnAsset(string address, byte[] bytes, int offset, int count)
        {
            if (!Remove(address) || address != hash || State != SceneState.Fetching) return;
            ScenePlan plan;
            try
            {
                plan = new ScenePlan(SceneDecoder.Decode(bytes, offset, count), budget);
            }
            catch (DecodeException error)
            {
                State = SceneState.Unreadable;
                Failure = error.Message;
                return;
            }
            if (!hasChanges) before = Plan;
            hasChanges = true;
            Plan = plan;
            PlanHash = address;
            State = SceneState.Shown;
            FailedCount = 0;
            foreach (SceneAsset asset in plan.Assets) Want(asset);
        }

        /// <summary>An asset cannot be had. The specification is requested again after a second, unless another scene comes.</summary>
        public void OnFailed(string address, string reason, long nowNs)
        {
            if (!Remove(address)) return;
            if (address != hash || State != SceneState.Fetching)
            {
                FailedCount++;
                return;
            }
            Failure = reason;
            retryAt = nowNs + RetryNs;
        }

        /// <summary>Return the changes since the last call, null when there are none: apply them to what is shown.</summary>
        public SceneChanges TakeChanges()
        {
            if (!hasChanges) return null;
            hasChanges = false;
            SceneChanges changes = new SceneChanges(before, Plan);
            before = null;
            return changes;
        }

        private void Want(SceneAsset asset)
        {
            if (missing.ContainsKey(asset.Address)) return;
            missing[asset.Address] = asset;
            MissingBytes += Math.Max(0, asset.Bytes);
            wanted.Add(asset);
        }

        private bool Remove(string address)
        {
            if (!missing.TryGetValue(address, out SceneAsset asset)) return false;
            missing.Remove(address);
            MissingBytes = missing.Count == 0 ? 0.0 : MissingBytes - Math.Max(0, asset.Bytes);
            return true;
        }

        /// <summary>Want nothing more of the scene before.</summary>
        private void DropAll()
        {
            HashSet<string> unsent = new HashSet<string>();
            foreach (SceneAsset asset in wanted) unsent.Add(asset.Address);
            foreach (string address in missing.Keys) if (!unsent.Contains(address)) dropped.Add(address);
            wanted.Clear();
            missing.Clear();
            MissingBytes = 0.0;
        }
    }
}
