// Assets that are kept on the headset, by the hash of their bytes. Pure: files are behind a port (IrisSession.Storage has them).
//
// What is read is hashed again, so a damaged file is never shown. Assets of the present scene are not evicted: a cache that they fill
// is full, and what does not fit is shown without being kept.
using System;
using System.Collections.Generic;
using System.Security.Cryptography;

namespace IrisSession.Core
{
    /// <summary>One file of a cache.</summary>
    public readonly struct AssetFile
    {
        public readonly string Name;
        public readonly long Bytes;

        /// <summary>When it was used last, in any unit that grows.</summary>
        public readonly long UsedAt;

        public AssetFile(string name, long bytes, long usedAt)
        {
            Name = name;
            Bytes = bytes;
            UsedAt = usedAt;
        }
    }

    /// <summary>Files of one folder. Nothing here throws: what the system refuses is false or null.</summary>
    public interface IAssetFiles
    {
        /// <summary>Return the files, without those that a kill has left half-written.</summary>
        IReadOnlyList<AssetFile> List();

        /// <summary>Return the content, null when the file is missing, unreadable, or has more than `maxBytes`.</summary>
        byte[] Read(string name, long maxBytes);

        /// <summary>Write a whole file or none, whenever the program is killed.</summary>
        /// <returns>False when it cannot be written, as on a full disk.</returns>
        bool Write(string name, byte[] bytes, int offset, int count);

        /// <summary>Note that a file was used now.</summary>
        void Touch(string name);

        /// <summary>Remove a file, if it is there.</summary>
        /// <returns>False when it is there and cannot be removed.</returns>
        bool Delete(string name);
    }

    /// <summary>What became of an asset.</summary>
    public enum CacheResult
    {
        /// <summary>It is kept.</summary>
        Kept,

        /// <summary>Its hash is not its address: it is of no use. Request it again.</summary>
        Damaged,

        /// <summary>The assets of the present scene fill the cache. Show it without keeping it.</summary>
        Full,

        /// <summary>The system did not write it: the disk is full, or the folder cannot be written. Show it without keeping it.</summary>
        Unwritable,
    }

    /// <summary>Assets on the headset, at most `LimitBytes` of them; the ones that were not used for longest go first. Threads that share it lock it.</summary>
    public sealed class AssetCache
    {
        /// <summary>Room for many scenes on a headset with 128 GB.</summary>
        public const long DefaultLimitBytes = 2L << 30;

        private sealed class Entry
        {
            public long Bytes;
            public long UsedAt;
        }

        private readonly IAssetFiles files;
        private readonly Dictionary<string, Entry> entries = new Dictionary<string, Entry>();
        private readonly HashSet<string> pinned = new HashSet<string>();
        private long clock;

        /// <summary>Read what is in the folder.</summary>
        public AssetCache(IAssetFiles files, long limitBytes = DefaultLimitBytes)
        {
            this.files = files;
            LimitBytes = limitBytes;
            List<AssetFile> known = new List<AssetFile>();
            foreach (AssetFile file in files.List()) if (SceneFollower.IsAddress(file.Name)) known.Add(file);
            known.Sort((a, b) => a.UsedAt != b.UsedAt ? a.UsedAt.CompareTo(b.UsedAt) : string.CompareOrdinal(a.Name, b.Name));
            foreach (AssetFile file in known)
            {
                entries[file.Name] = new Entry { Bytes = file.Bytes, UsedAt = ++clock };
                TotalBytes += file.Bytes;
            }
            MakeRoom(0);
        }

        public long LimitBytes { get; }

        /// <summary>Bytes of all that is kept.</summary>
        public long TotalBytes { get; private set; }

        public int Count { get { return entries.Count; } }

        /// <summary>`Kept`, or why the newest asset was not: for the panel.</summary>
        public CacheResult State { get; private set; }

        /// <summary>Assets that were found damaged, and removed.</summary>
        public long DamagedCount { get; private set; }

        public long EvictedCount { get; private set; }

        /// <summary>Assets that were not kept, for want of room or because of the system.</summary>
        public long UnkeptCount { get; private set; }

        /// <summary>Return whether an asset is said to be kept; `Read` may still find it damaged.</summary>
        public bool Contains(string address) { return entries.ContainsKey(address); }

        /// <summary>Name the assets of the present scene: they are not evicted.</summary>
        public void Pin(IEnumerable<SceneAsset> assets)
        {
            pinned.Clear();
            foreach (SceneAsset asset in assets) pinned.Add(asset.Address);
            State = CacheResult.Kept;
        }

        /// <summary>Return the bytes of an asset whose hash is right, null when there are none. Damaged ones are removed.</summary>
        public byte[] Read(string address)
        {
            if (!entries.TryGetValue(address, out Entry entry)) return null;
            byte[] bytes = files.Read(address, AssetLoader.MaxAssetBytes);
            if (bytes != null && HasAddress(bytes, 0, bytes.Length, address))
            {
                entry.UsedAt = ++clock;
                files.Touch(address);
                return bytes;
            }
            DamagedCount++;
            Remove(address);
            return null;
        }

        /// <summary>Keep an asset. Whatever becomes of it, its bytes can be shown unless they are damaged.</summary>
        public CacheResult Store(string address, byte[] bytes, int offset, int count)
        {
            if (!SceneFollower.IsAddress(address) || !HasAddress(bytes, offset, count, address)) return CacheResult.Damaged;
            if (entries.TryGetValue(address, out Entry known))
            {
                known.UsedAt = ++clock;
                return State = CacheResult.Kept;
            }
            if (!MakeRoom(count)) return NoteUnkept(CacheResult.Full);
            if (!files.Write(address, bytes, offset, count)) return NoteUnkept(CacheResult.Unwritable);
            entries[address] = new Entry { Bytes = count, UsedAt = ++clock };
            TotalBytes += count;
            return State = CacheResult.Kept;
        }

        /// <summary>Remove everything, as a person asked for.</summary>
        public void Clear()
        {
            foreach (string address in new List<string>(entries.Keys)) Remove(address);
            State = CacheResult.Kept;
        }

        /// <summary>Return whether bytes are those that an address names.</summary>
        public static bool HasAddress(byte[] bytes, int offset, int count, string address)
        {
            byte[] digest;
            using (SHA256 hash = SHA256.Create()) digest = hash.ComputeHash(bytes, offset, count);
            if (address.Length != 2 * digest.Length) return false;
            for (int i = 0; i < address.Length; i++)
            {
                int digit = (i % 2 == 0 ? digest[i / 2] >> 4 : digest[i / 2]) & 15;
                if (address[i] != "0123456789abcdef"[digit]) return false;
            }
            return true;
        }

        private CacheResult NoteUnkept(CacheResult result)
        {
            UnkeptCount++;
            return State = result;
        }

        /// <summary>Evict until `count` bytes fit. Returns false, without evicting anything, when that cannot be.</summary>
        private bool MakeRoom(long count)
        {
            if (TotalBytes + count <= LimitBytes) return true;
            List<KeyValuePair<string, Entry>> free = new List<KeyValuePair<string, Entry>>();
            long least = TotalBytes;
            foreach (KeyValuePair<string, Entry> one in entries)
            {
                if (pinned.Contains(one.Key)) continue;
                free.Add(one);
                least -= one.Value.Bytes;
            }
            if (least + count > LimitBytes) return false;
            free.Sort((a, b) => a.Value.UsedAt.CompareTo(b.Value.UsedAt));
            for (int i = 0; i < free.Count && TotalBytes + count > LimitBytes; i++) if (Remove(free[i].Key)) EvictedCount++;
            return TotalBytes + count <= LimitBytes;
        }

        /// <summary>Remove an asset. What the system does not remove still counts.</summary>
        private bool Remove(string address)
        {
            if (!files.Delete(address)) return false;
            TotalBytes -= entries[address].Bytes;
            entries.Remove(address);
            return true;
        }
    }
}
