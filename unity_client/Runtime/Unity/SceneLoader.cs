// Makes meshes and pictures of assets, on a thread of its own: the engine's thread takes what is ready.
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Unity
{
    /// <summary>What is made of assets.</summary>
    public enum LoadKind
    {
        Part,
        Texture,
        Deformable,
    }

    /// <summary>One thing that is ready, or cannot be had.</summary>
    public sealed class LoadedThing
    {
        public readonly ScenePlan Plan;
        public readonly LoadKind Kind;

        /// <summary>Index in `ScenePlan.Parts`, `SceneSpec.Textures` or `ScenePlan.Deformables`.</summary>
        public readonly int Index;

        internal LoadedThing(ScenePlan plan, LoadKind kind, int index)
        {
            Plan = plan;
            Kind = kind;
            Index = index;
        }

        public PartMesh Mesh { get; internal set; }

        /// <summary>True when `Mesh` is of coarser levels: the finer assets are not here yet.</summary>
        public bool IsCoarse { get; internal set; }

        public TextureImage Image { get; internal set; }

        public DeformableDecoder Decoder { get; internal set; }

        public DeformableSurface Surface { get; internal set; }

        /// <summary>Why it cannot be shown, for people; empty when it can, or when assets are missing.</summary>
        public string Problem { get; internal set; } = "";

        /// <summary>True when assets are missing: request it again when more have come.</summary>
        public bool IsMissing { get { return Problem.Length == 0 && Mesh == null && Image == null && Surface == null; } }
    }

    /// <summary>A thread that makes things of one plan after another. `ISceneAssets` is called on it.</summary>
    public sealed class SceneLoader : IDisposable
    {
        private readonly ISceneAssets assets;
        private readonly ArrayDecoder decoder = new ArrayDecoder();
        private readonly Queue<LoadedThing> requests = new Queue<LoadedThing>();
        private readonly Queue<LoadedThing> ready = new Queue<LoadedThing>();
        private readonly HashSet<(LoadKind, int)> waiting = new HashSet<(LoadKind, int)>();
        private ScenePlan plan;
        private bool isDisposed;
        private bool isBusy;

        public SceneLoader(ISceneAssets assets)
        {
            this.assets = assets;
            Thread thread = new Thread(Run) { IsBackground = true, Name = "iris-session scene", Priority = ThreadPriority.BelowNormal };
            thread.Start();
        }

        /// <summary>True when nothing is requested, made or ready.</summary>
        public bool IsIdle { get { lock (requests) return !isBusy && requests.Count == 0 && ready.Count == 0; } }

        /// <summary>Work for another plan: what was requested of the one before is not needed.</summary>
        public void Begin(ScenePlan plan)
        {
            lock (requests)
            {
                this.plan = plan;
                requests.Clear();
                ready.Clear();
                waiting.Clear();
            }
        }

        /// <summary>Request one thing of the plan, unless it is requested already. The plan bounds how many there are.</summary>
        public void Request(LoadKind kind, int index)
        {
            lock (requests)
            {
                if (isDisposed || !waiting.Add((kind, index))) return;
                requests.Enqueue(new LoadedThing(plan, kind, index));
                Monitor.Pulse(requests);
            }
        }

        /// <summary>Take the next thing that is ready; null when there is none.</summary>
        public LoadedThing Take()
        {
            lock (requests)
            {
                if (ready.Count == 0) return null;
                LoadedThing thing = ready.Dequeue();
                waiting.Remove((thing.Kind, thing.Index));
                return thing;
            }
        }

        /// <summary>End the thread after what it does now.</summary>
        public void Dispose()
        {
            lock (requests)
            {
                isDisposed = true;
                requests.Clear();
                Monitor.Pulse(requests);
            }
        }

        private void Run()
        {
            while (true)
            {
                LoadedThing thing;
                lock (requests)
                {
                    isBusy = false;
                    while (requests.Count == 0 && !isDisposed) Monitor.Wait(requests);
                    if (isDisposed) return;
                    thing = requests.Dequeue();
                    isBusy = true;
                }
                try
                {
                    Make(thing);
                }
                catch (DecodeException error)
                {
                    thing.Problem = error.Message;
                }
                catch (OutOfMemoryException)
                {
                    thing.Problem = "there is not enough memory for it";
                }
                catch (Exception error)
                {
                    thing.Problem = error.Message; // a defect of ours costs one thing, not the thread and the scene
                }
                lock (requests) if (thing.Plan == plan) ready.Enqueue(thing);
            }
        }

        private void Make(LoadedThing thing)
        {
            switch (thing.Kind)
            {
                case LoadKind.Part:
                    ScenePart part = thing.Plan.Parts[thing.Index];
                    thing.Mesh = PartMesh.Build(thing.Plan, part, assets, decoder);
                    thing.IsCoarse = thing.Mesh == null;
                    if (thing.IsCoarse) thing.Mesh = PartMesh.Build(thing.Plan, part, assets, decoder, true);
                    break;
                case LoadKind.Texture:
                    TextureLevel level = thing.Plan.FindTextureLevel(thing.Index);
                    byte[] picture = assets.Find(level.Address);
                    if (picture != null) thing.Image = TextureImage.Read(level, picture, decoder);
                    break;
                default:
                    MakeDeformable(thing, thing.Plan.Deformables[thing.Index]);
                    break;
            }
        }

        private void MakeDeformable(LoadedThing thing, Deformable part)
        {
            byte[] bytes = assets.Find(part.Address);
            if (bytes == null) return;
            ArrayAsset asset = decoder.Decode(bytes);
            byte[] plan = asset.RequireBytes(ArrayName.Plan, ArrayAsset.Any);
            DeformableTopology topology = new DeformableTopology(plan, 0, plan.Length);
            int corners = part.Dim == 1 ? 2 : 3;
            int[] elements = asset.RequireIndices(ArrayName.Elements, topology.VertexCount, ArrayAsset.Any, corners);
            float[] uv = asset.Find(ArrayName.Uv) == null ? null : asset.RequireFloats(ArrayName.Uv, elements.Length / corners, corners, 2);
            float[] rest = asset.RequireFloats(ArrayName.Position, topology.VertexCount, 3);
            SheetLook look = new SheetLook((int)part.Dim, part.Radius, part.Flat);
            DeformableSurface surface = DeformableSurface.Make(look, topology.VertexCount, elements, part.Dim == 1 ? null : uv);
            surface.Build(rest);
            thing.Decoder = new DeformableDecoder(topology, new Inflater());
            thing.Surface = surface;
        }
    }
}
