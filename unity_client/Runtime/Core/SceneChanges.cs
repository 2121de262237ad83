// The difference between two plans: what a client that shows one removes, adds and keeps to show the other.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Difference between two plans, by content and by id.</summary>
    public sealed class SceneChanges
    {
        /// <summary>Indices in the parts before that are to be removed, and after that are to be added.</summary>
        public readonly List<int> RemovedParts = new List<int>();
        public readonly List<int> AddedParts = new List<int>();

        /// <summary>For each part after, the index of the same one before, -1 for a new one.</summary>
        public readonly int[] Kept;

        /// <summary>Ids.</summary>
        public readonly List<long> RemovedBodies = new List<long>();
        public readonly List<long> AddedBodies = new List<long>();

        /// <summary>Ids of bodies that have another rest pose, parent or name, or move now and did not before, or the reverse.</summary>
        public readonly List<long> ChangedBodies = new List<long>();

        /// <summary>Names of streams of deformables.</summary>
        public readonly List<string> RemovedDeformables = new List<string>();
        public readonly List<string> AddedDeformables = new List<string>();

        /// <summary>Assets that the scene before does not need.</summary>
        public readonly List<SceneAsset> AddedAssets = new List<SceneAsset>();

        /// <summary>True when lights or surroundings differ.</summary>
        public readonly bool IsLightingChanged;

        /// <summary>Compare two plans; `before` is null when nothing is shown yet.</summary>
        public SceneChanges(ScenePlan before, ScenePlan after)
        {
            Kept = new int[after.Parts.Length];
            CompareParts(before, after);
            CompareBodies(before, after);
            CompareDeformables(before, after);
            HashSet<string> known = new HashSet<string>();
            if (before != null) foreach (SceneAsset asset in before.Assets) known.Add(asset.Address);
            foreach (SceneAsset asset in after.Assets) if (!known.Contains(asset.Address)) AddedAssets.Add(asset);
            IsLightingChanged = before == null || !IsSameLighting(before, after);
        }

        /// <summary>True when both are drawn alike.</summary>
        public bool IsEmpty
        {
            get
            {
                return RemovedParts.Count + AddedParts.Count + RemovedBodies.Count + AddedBodies.Count + ChangedBodies.Count + RemovedDeformables.Count + AddedDeformables.Count == 0 && !IsLightingChanged;
            }
        }

        private void CompareParts(ScenePlan before, ScenePlan after)
        {
            Dictionary<string, Queue<int>> known = new Dictionary<string, Queue<int>>();
            for (int i = 0; before != null && i < before.Parts.Length; i++)
            {
                if (!known.TryGetValue(before.Parts[i].Key, out Queue<int> same)) known[before.Parts[i].Key] = same = new Queue<int>();
                same.Enqueue(i);
            }
            for (int i = 0; i < after.Parts.Length; i++)
            {
                bool isKept = known.TryGetValue(after.Parts[i].Key, out Queue<int> same) && same.Count > 0;
                Kept[i] = isKept ? same.Dequeue() : -1;
                if (!isKept) AddedParts.Add(i);
            }
            foreach (Queue<int> left in known.Values) RemovedParts.AddRange(left);
            RemovedParts.Sort();
        }

        private void CompareBodies(ScenePlan before, ScenePlan after)
        {
            Dictionary<long, SceneBody> known = new Dictionary<long, SceneBody>();
            if (before != null) foreach (SceneBody body in before.Bodies) known[body.Id] = body;
            foreach (SceneBody body in after.Bodies)
            {
                if (!known.TryGetValue(body.Id, out SceneBody old)) AddedBodies.Add(body.Id);
                else if (!old.T_world_body.Equals(body.T_world_body) || old.IsMoving != body.IsMoving || old.Parent != body.Parent || old.Name != body.Name) ChangedBodies.Add(body.Id);
                known.Remove(body.Id);
            }
            RemovedBodies.AddRange(known.Keys);
            RemovedBodies.Sort();
        }

        private void CompareDeformables(ScenePlan before, ScenePlan after)
        {
            Dictionary<string, string> known = new Dictionary<string, string>();
            if (before != null) foreach (Deformable part in before.Deformables) known[part.Stream] = Describe(before, part);
            foreach (Deformable part in after.Deformables)
            {
                if (known.TryGetValue(part.Stream, out string old) && old == Describe(after, part)) known.Remove(part.Stream);
                else AddedDeformables.Add(part.Stream);
            }
            RemovedDeformables.AddRange(known.Keys);
        }

        /// <summary>Return the content of a deformable and of its material.</summary>
        private static string Describe(ScenePlan plan, Deformable part)
        {
            int texture = ScenePartBuilder.FindColorTexture(plan.Spec, part.Material);
            string material = part.Material < 0 ? "" : Convert.ToBase64String(plan.Spec.Materials[part.Material].Encode());
            return Convert.ToBase64String(part.Encode()) + material + (texture < 0 ? "" : plan.FindTextureLevel(texture)?.Address);
        }

        private static bool IsSameLighting(ScenePlan before, ScenePlan after)
        {
            if (before.Spec.Lights.Length != after.Spec.Lights.Length || !IsSame(before.Spec.Environment.Encode(), after.Spec.Environment.Encode())) return false;
            for (int i = 0; i < after.Spec.Lights.Length; i++) if (!IsSame(before.Spec.Lights[i].Encode(), after.Spec.Lights[i].Encode())) return false;
            return FindSky(before) == FindSky(after);
        }

        private static string FindSky(ScenePlan plan)
        {
            int sky = (int)plan.Spec.Environment.Skybox;
            return sky < 0 ? "" : plan.FindTextureLevel(sky)?.Address ?? "";
        }

        private static bool IsSame(byte[] a, byte[] b)
        {
            bool isSame = a.Length == b.Length;
            for (int i = 0; isSame && i < a.Length; i++) isSame = a[i] == b[i];
            return isSame;
        }
    }
}
