// A cloth, the skin of a body, or ropes: one mesh in the world, whose points are written in place.
using System;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;
using UnityEngine.Rendering;
using Material = UnityEngine.Material;
using Mesh = UnityEngine.Mesh;

namespace IrisSession.Unity
{
    /// <summary>One deformable. Frames of its stream allocate nothing.</summary>
    public sealed class DeformableView
    {
        public readonly string Stream;
        public readonly Material Material;
        private readonly Deformable part;
        private readonly DeformableStream stream;
        private readonly DeformableSurface surface;
        private readonly float[] shown;
        private readonly float[] before;
        private readonly GameObject place;
        private readonly Mesh mesh;

        public DeformableView(Deformable part, DeformableStream stream, DeformableSurface surface, Transform root, Material material)
        {
            this.part = part;
            this.stream = stream;
            this.surface = surface;
            Stream = part.Stream;
            Material = material;
            shown = new float[stream.Decoder.Positions.Length];
            before = new float[shown.Length];
            mesh = MeshUpload.MakeDynamic(surface, part.Name);
            MeshUpload.Update(mesh, surface); // the rest shape
            place = new GameObject(part.Name);
            place.transform.SetParent(root, false);
            place.AddComponent<MeshFilter>().sharedMesh = mesh;
            MeshRenderer renderer = place.AddComponent<MeshRenderer>();
            renderer.sharedMaterial = material;
            renderer.shadowCastingMode = ShadowCastingMode.Off;
            renderer.receiveShadows = false;
        }

        /// <summary>Show its vertices at a session time. What did not change is not sent to the graphics card again.</summary>
        public void Show(long wantedNs)
        {
            if (!stream.Buffer.TryGetVertices(wantedNs, shown)) return;
            if (shown.AsSpan().SequenceEqual(before)) return;
            Array.Copy(shown, before, shown.Length);
            if (surface.Build(shown)) MeshUpload.Update(mesh, surface);
        }

        /// <summary>Take a texture if it is ours.</summary>
        public void SetTexture(ScenePlan plan, string key, Texture2D texture)
        {
            SceneSurface look = SceneSurface.FromDeformable(plan, part);
            if (look.Texture >= 0 && SceneView.MakeTextureKey(plan, look.Texture) == key) MaterialCache.SetTexture(Material, look.Mapping, texture);
        }

        public void Destroy()
        {
            UnityEngine.Object.Destroy(mesh);
            UnityEngine.Object.Destroy(place);
        }
    }
}
