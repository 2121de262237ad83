// Heads and hands of the other participants.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;
using UnityEngine.Rendering;
using Avatar = IrisSession.Core.Avatar;
using Material = UnityEngine.Material;
using Mesh = UnityEngine.Mesh;

namespace IrisSession.Unity
{
    /// <summary>One object for each avatar. Frames without other people allocate nothing.</summary>
    public sealed class AvatarViews
    {
        /// <summary>Share of its own colour that an avatar shines with, so that it is seen in the dark.</summary>
        private const float Emission = 0.45f;
        private readonly AvatarTable table;
        private readonly MaterialCache materials;
        private readonly Transform root;
        private readonly Dictionary<Avatar, GameObject> objects = new Dictionary<Avatar, GameObject>();
        private readonly Dictionary<int, Material> colors = new Dictionary<int, Material>();
        private readonly Mesh head = MeshUpload.Make(AvatarShapes.Make(true), "head");
        private readonly Mesh hand = MeshUpload.Make(AvatarShapes.Make(false), "hand");

        public AvatarViews(AvatarTable table, MaterialCache materials, Transform root)
        {
            this.table = table;
            this.materials = materials;
            this.root = root;
        }

        public int Count { get { return objects.Count; } }

        /// <summary>Move them to where they were at a session time. Once a frame.</summary>
        public void Show(long nowNs, IReadOnlyDictionary<string, ParticipantInfo> participants)
        {
            IReadOnlyList<Avatar> gone = table.Show(nowNs, participants);
            for (int i = 0; i < gone.Count; i++) Remove(gone[i]);
            IReadOnlyList<Avatar> shown = table.Avatars;
            for (int i = 0; i < shown.Count; i++)
            {
                if (!objects.TryGetValue(shown[i], out GameObject one)) objects[shown[i]] = one = Make(shown[i]);
                UnityValues.Place(one.transform, shown[i].T_world_device);
            }
        }

        public void Destroy()
        {
            foreach (GameObject one in objects.Values) Object.Destroy(one);
            objects.Clear();
            foreach (Material one in colors.Values) materials.Release(one);
            colors.Clear();
            Object.Destroy(head);
            Object.Destroy(hand);
        }

        private GameObject Make(Avatar avatar)
        {
            int color = AvatarTable.FindColor(avatar.Participant);
            if (!colors.TryGetValue(color, out Material material))
            {
                colors[color] = material = materials.Make(UnityValues.ToVector4(color, 1f), false, false);
                material.SetFloat(ShaderNames.Emission, Emission);
            }
            GameObject one = new GameObject(avatar.Participant + " " + avatar.Device);
            one.transform.SetParent(root, false);
            one.AddComponent<MeshFilter>().sharedMesh = avatar.IsHead ? head : hand;
            MeshRenderer renderer = one.AddComponent<MeshRenderer>();
            renderer.sharedMaterial = material;
            renderer.shadowCastingMode = ShadowCastingMode.Off;
            renderer.receiveShadows = false;
            return one;
        }

        private void Remove(Avatar avatar)
        {
            if (!objects.TryGetValue(avatar, out GameObject one)) return;
            Object.Destroy(one);
            objects.Remove(avatar);
        }
    }
}
