// What to draw of a scene, in as few draw calls as possible, and the assets that it needs. All poses are those of the wire:
// UnityAxes.cs has what becomes of them.
//
//     specification --SceneLevels--> levels of detail --ScenePlan--> parts (one draw call each), assets in order
//
// Visuals of one body that look the same are one part, merged; those of all bodies that never move are merged in the world. Parts
// that are the same on several bodies are one part with several instances. What is transparent stays apart, because it is sorted
// by distance.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>One rigid body.</summary>
    public sealed class SceneBody
    {
        /// <summary>That of state frames: `SessionMirror.IndexOfId` has the row. 0 is the world.</summary>
        public readonly long Id;
        public readonly string Name;

        /// <summary>-1 for none.</summary>
        public readonly long Parent;

        /// <summary>Pose in the world of the initial state.</summary>
        public readonly RigidTransform T_world_body;

        /// <summary>A body that is not stays there for good.</summary>
        public readonly bool IsMoving;

        internal SceneBody(Body body)
        {
            Id = body.Id;
            Name = body.Name;
            Parent = body.Parent;
            T_world_body = SceneDecoder.ToTransform(body.T_world_body);
            IsMoving = body.Moving;
        }
    }

    /// <summary>How a texture lies on a shape.</summary>
    public enum TextureMapping
    {
        None,

        /// <summary>By texture coordinates.</summary>
        Map,

        /// <summary>By the direction from the middle of the shape.</summary>
        Cube,
    }

    /// <summary>How a part looks.</summary>
    public sealed class SceneLook
    {
        /// <summary>Index in `SceneSpec.Materials`, -1 for none.</summary>
        public readonly int Material;

        /// <summary>Red, green, blue, alpha, 0 to 1, as MuJoCo blends them, without colour management.</summary>
        public readonly double[] Rgba;

        /// <summary>Index in `SceneSpec.Textures` of the texture that multiplies the colour, -1 for none.</summary>
        public readonly int Texture;
        public readonly TextureMapping Mapping;

        /// <summary>True when what is behind it is seen through it.</summary>
        public readonly bool IsTransparent;

        internal SceneLook(int material, double[] rgba, int texture, TextureMapping mapping, bool isTransparent)
        {
            Material = material;
            Rgba = rgba;
            Texture = texture;
            Mapping = mapping;
            IsTransparent = isTransparent;
        }
    }

    /// <summary>One shape of a part.</summary>
    public sealed class SceneShape
    {
        /// <summary>Of the specification; of a site, minus one minus its id.</summary>
        public readonly long Visual;
        public readonly Geometry Geometry;

        /// <summary>Pose in the frame of the part.</summary>
        public readonly RigidTransform T_part_shape;

        internal SceneShape(long visual, Geometry geometry, RigidTransform pose)
        {
            Visual = visual;
            Geometry = geometry;
            T_part_shape = pose;
        }
    }

    /// <summary>One place of a part.</summary>
    public readonly struct ScenePlace
    {
        /// <summary>Body that it moves with; -1: none, it stays.</summary>
        public readonly long Body;

        /// <summary>Pose in the frame of the body, or in the world.</summary>
        public readonly RigidTransform T_body_part;

        internal ScenePlace(long body, RigidTransform pose)
        {
            Body = body;
            T_body_part = pose;
        }
    }

    /// <summary>One draw call: a mesh of one or more shapes, in one or more places.</summary>
    public sealed class ScenePart
    {
        /// <summary>Content: parts with equal keys are drawn alike, whatever scene they are of.</summary>
        public readonly string Key;
        public readonly SceneLook Look;
        public readonly SceneShape[] Shapes;
        public readonly ScenePlace[] Places;

        /// <summary>True for the plane: it is seen from behind with a part of its alpha, and may be without end.</summary>
        public readonly bool IsPlane;

        internal ScenePart(string key, SceneLook look, SceneShape[] shapes, ScenePlace[] places)
        {
            Key = key;
            Look = look;
            Shapes = shapes;
            Places = places;
            IsPlane = shapes[0].Geometry.Kind == GeometryKind.Plane;
        }
    }

    /// <summary>An asset to fetch.</summary>
    public readonly struct SceneAsset
    {
        public readonly string Address;

        /// <summary>As the specification states; the asset itself decides.</summary>
        public readonly long Bytes;

        /// <summary>An `AssetEncoding`.</summary>
        public readonly string Encoding;

        internal SceneAsset(string address, long bytes, string encoding)
        {
            Address = address;
            Bytes = bytes;
            Encoding = encoding;
        }
    }

    /// <summary>A scene as it is drawn within a budget.</summary>
    public sealed class ScenePlan
    {
        /// <summary>Problems that are kept for people.</summary>
        private const int MaxProblems = 16;

        public readonly SceneSpec Spec;
        public readonly SceneBudget Budget;
        public readonly SceneLevels Levels;
        public readonly SceneBody[] Bodies;
        public readonly ScenePart[] Parts;

        /// <summary>Deformables that are shown at first.</summary>
        public readonly Deformable[] Deformables;

        /// <summary>Each once, in the order in which they are to be fetched: what shows something early comes first.</summary>
        public readonly SceneAsset[] Assets;

        /// <summary>Visuals that were left out because there would be too many draw calls: the smallest ones.</summary>
        public readonly int HiddenCount;

        /// <summary>Visuals whose numbers cannot be drawn.</summary>
        public readonly int UnusableCount;

        /// <summary>What of the scene is not shown, for people.</summary>
        public readonly IReadOnlyList<string> Problems;

        private readonly List<string> problems = new List<string>();

        /// <summary>Plan a specification that was decoded by <see cref="SceneDecoder"/>.</summary>
        public ScenePlan(SceneSpec spec, SceneBudget budget)
        {
            Spec = spec;
            Budget = budget;
            Problems = problems;
            Levels = SceneLevels.Choose(spec, budget.WithObjects(0));
            Bodies = new SceneBody[spec.Bodies.Length];
            for (int i = 0; i < Bodies.Length; i++) Bodies[i] = new SceneBody(spec.Bodies[i]);
            Deformables = ListDeformables();
            ScenePartBuilder builder = new ScenePartBuilder(this, AddProblem);
            List<ScenePart> parts = builder.Build();
            UnusableCount = builder.UnusableCount;
            HiddenCount = budget.Objects > 0 ? HideSmallest(parts, Math.Max(1, budget.Objects - Deformables.Length)) : 0;
            Parts = parts.ToArray();
            Assets = ListAssets();
        }

        /// <summary>Draw calls of parts and deformables; the sky is one more.</summary>
        public int DrawCalls { get { return Parts.Length + Deformables.Length; } }

        /// <summary>False when even the coarsest levels exceed the budget, or something had to be left out.</summary>
        public bool Fits { get { return Levels.Fits && HiddenCount == 0; } }

        /// <summary>Return the level of a mesh that is drawn.</summary>
        public MeshLevel FindLevel(Geometry geometry)
        {
            return geometry.Mesh < 0 ? null : Spec.Meshes[geometry.Mesh].Levels[Levels.Meshes[geometry.Mesh]];
        }

        /// <summary>Return the level of a texture that is drawn: one that can be decoded; null when there is none.</summary>
        public TextureLevel FindTextureLevel(int texture)
        {
            TextureLevel[] levels = Spec.Textures[texture].Levels;
            for (int k = Levels.Textures[texture]; k < levels.Length; k++) if (levels[k].Encoding != AssetEncoding.Opaque) return levels[k];
            return null;
        }

        internal static bool IsFinite(double[] values)
        {
            foreach (double value in values) if (double.IsNaN(value) || double.IsInfinity(value)) return false;
            return true;
        }

        private void AddProblem(string text)
        {
            if (problems.Count < MaxProblems) problems.Add(text);
        }

        private Deformable[] ListDeformables()
        {
            HashSet<long> groups = new HashSet<long>(Spec.GroupsShown);
            List<Deformable> shown = new List<Deformable>();
            foreach (Deformable part in Spec.Deformables)
            {
                if (part.Rgba[3] > 0.0 && groups.Contains(part.Group) && IsFinite(part.Rgba)) shown.Add(part);
            }
            return shown.ToArray();
        }

        /// <summary>Remove the parts whose largest shape is smallest until `most` are left. Returns how many visuals that were.</summary>
        private int HideSmallest(List<ScenePart> parts, int most)
        {
            if (parts.Count <= most) return 0;
            double[] sizes = new double[parts.Count];
            int[] order = new int[parts.Count];
            for (int i = 0; i < order.Length; i++)
            {
                order[i] = i;
                foreach (SceneShape shape in parts[i].Shapes) sizes[i] = Math.Max(sizes[i], SceneLevels.MeasureSize(Spec, shape.Geometry));
            }
            Array.Sort(order, (a, b) => sizes[a] != sizes[b] ? sizes[a].CompareTo(sizes[b]) : a.CompareTo(b));
            int hidden = 0;
            ScenePart[] all = parts.ToArray();
            for (int i = 0; i < all.Length - most; i++)
            {
                ScenePart part = all[order[i]];
                hidden += part.Shapes.Length * part.Places.Length;
                all[order[i]] = null;
            }
            parts.Clear();
            foreach (ScenePart part in all) if (part != null) parts.Add(part);
            AddProblem(hidden + " small things of the scene are not shown: there are too many for this headset");
            return hidden;
        }

        private SceneAsset[] ListAssets()
        {
            List<SceneAsset> assets = new List<SceneAsset>();
            HashSet<string> seen = new HashSet<string>();
            void Add(string address, long bytes, string encoding)
            {
                if (seen.Add(address)) assets.Add(new SceneAsset(address, bytes, encoding));
            }

            foreach (Deformable part in Deformables) Add(part.Address, part.Bytes, part.Encoding);
            List<MeshLevel> fine = new List<MeshLevel>();
            List<TextureLevel> textures = new List<TextureLevel>();
            HashSet<long> meshes = new HashSet<long>();
            HashSet<int> used = new HashSet<int>();
            foreach (ScenePart part in Parts)
            {
                foreach (SceneShape shape in part.Shapes)
                {
                    if (shape.Geometry.Hfield >= 0 && shape.Geometry.Mesh < 0)
                    {
                        HeightField field = Spec.Hfields[shape.Geometry.Hfield];
                        Add(field.Address, field.Bytes, field.Encoding);
                    }
                    if (shape.Geometry.Mesh < 0 || !meshes.Add(shape.Geometry.Mesh)) continue;
                    MeshLevel[] levels = Spec.Meshes[shape.Geometry.Mesh].Levels;
                    MeshLevel coarsest = levels[levels.Length - 1];
                    Add(coarsest.Address, coarsest.Bytes, coarsest.Encoding);
                    fine.Add(FindLevel(shape.Geometry));
                }
                if (part.Look.Texture >= 0 && used.Add(part.Look.Texture)) textures.Add(FindTextureLevel(part.Look.Texture));
            }
            foreach (Deformable part in Deformables)
            {
                int texture = ScenePartBuilder.FindColorTexture(Spec, part.Material);
                if (texture >= 0 && Spec.Textures[texture].Kind == TextureKind.Image && FindTextureLevel(texture) != null && used.Add(texture)) textures.Add(FindTextureLevel(texture));
            }
            int sky = (int)Spec.Environment.Skybox;
            if (sky >= 0 && FindTextureLevel(sky) != null && used.Add(sky)) textures.Add(FindTextureLevel(sky));
            foreach (MeshLevel level in fine) Add(level.Address, level.Bytes, level.Encoding);
            foreach (TextureLevel level in textures) Add(level.Address, level.Bytes, level.Encoding);
            return assets.ToArray();
        }
    }
}
