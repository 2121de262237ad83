// Digest of a mirror, for tests and diagnosis: equal for everyone who knows the same.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Computes the digest of the shared state.</summary>
    public static class MirrorHash
    {
        private const int DigestBytes = 16;

        /// <summary>
        /// Return 32 hex digits of everything shared, independent of when and how the mirror received it. Poses of anchors are part of it
        /// when there are any.
        /// </summary>
        public static string Compute(SessionMirror mirror)
        {
            WireWriter writer = new WireWriter();
            bool hasAnchors = mirror.Anchors.Count > 0;
            writer.WriteArrayHeader(hasAnchors ? 14 : 13);
            writer.Write(mirror.EventSeq);
            writer.Write(mirror.SceneEpoch);
            writer.Write(mirror.SceneRevision);
            writer.Write(mirror.SceneHash);
            writer.Write(mirror.TickPeriodNs);
            writer.Write(mirror.IsPaused);
            writer.Write(mirror.IsStopped);
            writer.Write(mirror.StopSeq);
            writer.Write(mirror.Episode);
            WriteValues(writer, mirror.Participants);
            WriteValues(writer, mirror.Leases);
            WriteValues(writer, mirror.Robots);
            writer.WriteArrayHeader(mirror.Bodies.Count);
            foreach (BodyInfo body in mirror.Bodies) writer.Write(body);
            if (hasAnchors)
            {
                writer.WriteArrayHeader(mirror.Anchors.Count);
                foreach (string id in SortKeys(mirror.Anchors))
                {
                    writer.WriteArrayHeader(2);
                    writer.Write(id);
                    writer.Write(mirror.Anchors[id].T_world_anchor);
                }
            }
            byte[] digest = Blake2b.Compute(writer.Data, 0, writer.Length, DigestBytes);
            return BitConverter.ToString(digest).Replace("-", "").ToLowerInvariant();
        }

        private static void WriteValues<T>(WireWriter writer, Dictionary<string, T> values) where T : WireValue
        {
            writer.WriteArrayHeader(values.Count);
            foreach (string key in SortKeys(values)) writer.Write(values[key]);
        }

        private static List<string> SortKeys<T>(Dictionary<string, T> values)
        {
            List<string> keys = new List<string>(values.Keys);
            keys.Sort(CompareCodePoints);
            return keys;
        }

        /// <summary>Compare by code points, as Python does; strings of C# compare by UTF-16.</summary>
        private static int CompareCodePoints(string a, string b)
        {
            for (int i = 0; i < a.Length && i < b.Length; i++)
            {
                if (a[i] == b[i]) continue;
                bool highA = char.IsSurrogate(a[i]), highB = char.IsSurrogate(b[i]);
                return highA != highB ? (highA ? 1 : -1) : a[i].CompareTo(b[i]);
            }
            return a.Length.CompareTo(b.Length);
        }
    }
}
