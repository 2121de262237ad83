// The scene that is shown: bodies, parts, textures, deformables, made one after the other as their assets come.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;
using ColorSpace = IrisSession.Protocol.ColorSpace;
using Mesh = UnityEngine.Mesh;
using Material = UnityEngine.Material;

namespace IrisSession.Unity
{
    /// <summary>Shows one plan after another. What both have stays as it is.</summary>
    public sealed class SceneView : IDisposable
    {
        /// <summary>Vertices and pixels that go to the graphics card in one frame: more would be seen as a stutter.</summary>
        private const int VerticesAFrame = 60_000;
        private const int PixelsAFrame = 1 << 20;

        /// <summary>Time until what had no assets is tried again when more have come [s].</summary>
        private const double RetryS = 0.25;

        /// <summary>Problems that are kept for people.</summary>
        private const int MaxProblems = 16;
        private readonly MaterialCache materials;
        private readonly MediaStreams media;
        private readonly SceneLoader loader;
        private readonly List<string> problems = new List<string>();
        private readonly Dictionary<string, Texture2D> textures = new Dictionary<string, Texture2D>();
        private readonly List<DeformableView> deformables = new List<DeformableView>();
        private readonly List<(LoadKind Kind, int Index)> missing = new List<(LoadKind Kind, int Index)>();
        private ScenePartView[] parts = new ScenePartView[0];
        private double retriedAt;
        private bool hasNewAssets;

        public SceneView(Transform root, MaterialCache materials, ISceneAssets assets, MediaStreams media)
        {
            this.materials = materials;
            this.media = media;
            Bodies = new SceneBodies(root);
            loader = new SceneLoader(assets);
        }

        public SceneBodies Bodies { get; }

        /// <summary>The plan that is shown, null before the first.</summary>
        public ScenePlan Plan { get; private set; }

        public SceneLighting Lighting { get; private set; }

        /// <summary>What cannot be shown, for people.</summary>
        public IReadOnlyList<string> Problems { get { return problems; } }

        /// <summary>True when everything whose assets are here is shown.</summary>
        public bool IsSettled { get { return loader.IsIdle; } }

        /// <summary>True when nothing is missing any more.</summary>
        public bool IsComplete { get { return loader.IsIdle && missing.Count == 0; } }

        public IReadOnlyList<DeformableView> Deformables { get { return deformables; } }

        /// <summary>Show another plan. `changes`: against the one before.</summary>
        public void Apply(ScenePlan plan, SceneChanges changes)
        {
            Bodies.Apply(plan, changes);
            problems.Clear();
            problems.AddRange(plan.Problems);
            missing.Clear();
            loader.Begin(plan);
            HashSet<string> kept = ListTextures(plan);
            foreach (string key in new List<string>(textures.Keys)) if (!kept.Contains(key)) ReleaseTexture(key);
            foreach (int index in changes.RemovedParts) ReleasePart(parts[index]);
            foreach (string stream in changes.RemovedDeformables) ReleaseDeformable(stream);
            ScenePartView[] before = parts;
            Plan = plan;
            parts = new ScenePartView[plan.Parts.Length];
            for (int i = 0; i < parts.Length; i++)
            {
                if (changes.Kept[i] >= 0) parts[i] = before[changes.Kept[i]];
                else parts[i] = MakePart(plan.Parts[i]);
                if (!parts[i].IsFine) loader.Request(LoadKind.Part, i);
                RequestTexture(plan.Parts[i].Look.Texture);
            }
            for (int i = 0; i < plan.Deformables.Length; i++)
            {
                if (changes.AddedDeformables.Contains(plan.Deformables[i].Stream) || !IsShown(plan.Deformables[i].Stream)) loader.Request(LoadKind.Deformable, i);
                RequestTexture(SceneSurface.FromDeformable(plan, plan.Deformables[i]).Texture);
            }
            if (changes.IsLightingChanged || Lighting == null || changes.ChangedBodies.Count + changes.RemovedBodies.Count > 0) Lighting = new SceneLighting(plan);
            if (Lighting.LeftOut > 0) AddProblem(Lighting.LeftOut + " lights of the scene are left out: headsets draw " + SceneLighting.MaxLights);
        }

        /// <summary>Return the mesh of a part, null while it is not here.</summary>
        public Mesh FindMesh(int part) { return part < parts.Length ? parts[part].Mesh : null; }

        /// <summary>Say that assets have come.</summary>
        public void OnAssets() { hasNewAssets = true; }

        /// <summary>Take what is ready, and draw what is drawn by calls. Once a frame.</summary>
        public void Draw(double nowS, long wantedNs)
        {
            if (hasNewAssets && nowS - retriedAt > RetryS)
            {
                hasNewAssets = false;
                retriedAt = nowS;
                foreach ((LoadKind Kind, int Index) one in missing) loader.Request(one.Kind, one.Index);
                missing.Clear();
            }
            TakeReady();
            for (int i = 0; i < parts.Length; i++) parts[i].Draw();
            for (int i = 0; i < deformables.Count; i++) deformables[i].Show(wantedNs);
        }

        public void Dispose()
        {
            loader.Dispose();
            foreach (ScenePartView part in parts) ReleasePart(part);
            parts = new ScenePartView[0];
            while (deformables.Count > 0) ReleaseDeformable(deformables[0].Stream);
            foreach (string key in new List<string>(textures.Keys)) ReleaseTexture(key);
        }

        private void TakeReady()
        {
            int vertices = 0, pixels = 0;
            while (vertices < VerticesAFrame && pixels < PixelsAFrame)
            {
                LoadedThing thing = loader.Take();
                if (thing == null) return;
                if (thing.Problem.Length > 0) AddProblem("a part of the scene is not shown: " + thing.Problem);
                else if (thing.IsMissing) missing.Add((thing.Kind, thing.Index));
                else if (thing.Kind == LoadKind.Part) vertices += ShowPart(thing);
                else if (thing.Kind == LoadKind.Texture) pixels += ShowTexture(thing);
                else vertices += ShowDeformable(thing);
            }
        }

        private ScenePartView MakePart(ScenePart part)
        {
            SceneSurface surface = SceneSurface.FromLook(Plan.Spec, part.Look);
            return new ScenePartView(part, Bodies, materials.Make(surface, FindTexture(surface.Texture), false), "part of " + part.Shapes.Length);
        }

        private int ShowPart(LoadedThing thing)
        {
            if (thing.IsCoarse) missing.Add((thing.Kind, thing.Index));
            if (thing.IsCoarse && parts[thing.Index].Mesh != null) return 0;
            parts[thing.Index].Show(MeshUpload.Make(thing.Mesh, "iris-session"), !thing.IsCoarse);
            return thing.Mesh.Positions.Length / 3;
        }

        private int ShowTexture(LoadedThing thing)
        {
            Texture2D texture = TextureUpload.Make(thing.Image, IsSrgb(thing.Index), thing.Plan.Spec.Textures[thing.Index].Kind != TextureKind.Image);
            if (texture == null)
            {
                AddProblem("a texture of the scene cannot be read");
                return 0;
            }
            string key = MakeTextureKey(thing.Plan, thing.Index);
            if (textures.ContainsKey(key)) ReleaseTexture(key);
            textures[key] = texture;
            for (int i = 0; i < parts.Length; i++)
            {
                SceneLook look = Plan.Parts[i].Look;
                if (look.Texture >= 0 && MakeTextureKey(Plan, look.Texture) == key) MaterialCache.SetTexture(parts[i].Material, look.Mapping, texture);
            }
            foreach (DeformableView view in deformables) view.SetTexture(Plan, key, texture);
            return thing.Image.Width * thing.Image.Height;
        }

        private int ShowDeformable(LoadedThing thing)
        {
            Deformable part = thing.Plan.Deformables[thing.Index];
            ReleaseDeformable(part.Stream);
            SceneSurface surface = SceneSurface.FromDeformable(Plan, part);
            Material material = materials.Make(surface, FindTexture(surface.Texture), part.Dim == 2);
            DeformableStream stream = media.AddDeformable(part.Stream, thing.Decoder);
            deformables.Add(new DeformableView(part, stream, thing.Surface, Bodies.Root, material));
            return thing.Surface.Positions.Length / 3;
        }

        private bool IsSrgb(int texture) { return Plan.Spec.Textures[texture].Colorspace == ColorSpace.Srgb; }

        internal static string MakeTextureKey(ScenePlan plan, int texture)
        {
            return plan.FindTextureLevel(texture)?.Address + plan.Spec.Textures[texture].Colorspace + plan.Spec.Textures[texture].Kind;
        }

        private HashSet<string> ListTextures(ScenePlan plan)
        {
            HashSet<string> keys = new HashSet<string>();
            foreach (ScenePart part in plan.Parts) if (part.Look.Texture >= 0) keys.Add(MakeTextureKey(plan, part.Look.Texture));
            foreach (Deformable part in plan.Deformables)
            {
                int texture = SceneSurface.FromDeformable(plan, part).Texture;
                if (texture >= 0) keys.Add(MakeTextureKey(plan, texture));
            }
            return keys;
        }

        private void RequestTexture(int texture)
        {
            if (texture >= 0 && FindTexture(texture) == null) loader.Request(LoadKind.Texture, texture);
        }

        private Texture2D FindTexture(int texture)
        {
            return texture >= 0 && textures.TryGetValue(MakeTextureKey(Plan, texture), out Texture2D found) ? found : null;
        }

        private void AddProblem(string text)
        {
            if (problems.Count < MaxProblems) problems.Add(text);
        }

        private void ReleasePart(ScenePartView part)
        {
            part.Destroy();
            materials.Release(part.Material);
        }

        private void ReleaseTexture(string key)
        {
            UnityEngine.Object.Destroy(textures[key]);
            textures.Remove(key);
        }

        private bool IsShown(string stream)
        {
            foreach (DeformableView one in deformables) if (one.Stream == stream) return true;
            return false;
        }

        private void ReleaseDeformable(string stream)
        {
            for (int i = deformables.Count - 1; i >= 0; i--)
            {
                if (deformables[i].Stream != stream) continue;
                deformables[i].Destroy();
                materials.Release(deformables[i].Material);
                deformables.RemoveAt(i);
                media.RemoveDeformable(stream);
            }
        }
    }
}
