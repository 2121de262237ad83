// Groups visuals into the parts of a ScenePlan.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.Text;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Builds the parts of one plan. Used once.</summary>
    internal sealed class ScenePartBuilder
    {
        /// <summary>Largest mesh that is merged, and largest merged one [vertices]: merging copies what meshes share.</summary>
        private const double MaxVertices = 20_000;
        private const double MaxMergedVertices = 200_000;

        /// <summary>Of bodies that do not move, a mesh of so many vertices that is there twice becomes instances of one.</summary>
        private const double MinInstancedVertices = 500;

        /// <summary>Places of one part: what Unity draws in one call.</summary>
        private const int MaxPlaces = 1_000;

        /// <summary>Largest coordinate [m]: float32 has steps of 6 cm there.</summary>
        private const double MaxLength = 1e6;
        private const long World = -1;

        /// <summary>Visuals of one frame that may be one mesh.</summary>
        private sealed class Cluster
        {
            public long Body;
            public SceneLook Look;
            public string LookKey;
            public double Vertices;
            public RigidTransform T_body_part = RigidTransform.Identity;
            public readonly List<SceneShape> Shapes = new List<SceneShape>();
            public readonly StringBuilder Key = new StringBuilder();
        }

        private readonly ScenePlan plan;
        private readonly SceneSpec spec;
        private readonly Action<string> onProblem;
        private readonly Dictionary<long, SceneBody> bodies = new Dictionary<long, SceneBody>();
        private readonly Dictionary<string, Cluster> open = new Dictionary<string, Cluster>();
        private readonly List<Cluster> clusters = new List<Cluster>();
        private readonly Dictionary<string, int> fixedCounts = new Dictionary<string, int>();
        private readonly string[] materialKeys;

        public ScenePartBuilder(ScenePlan plan, Action<string> onProblem)
        {
            this.plan = plan;
            this.onProblem = onProblem;
            spec = plan.Spec;
            materialKeys = new string[spec.Materials.Length];
            foreach (SceneBody body in plan.Bodies) bodies[body.Id] = body;
        }

        /// <summary>Visuals whose numbers are not finite.</summary>
        public int UnusableCount { get; private set; }

        /// <summary>Return the parts, in the order of the specification.</summary>
        public List<ScenePart> Build()
        {
            HashSet<long> groups = new HashSet<long>(spec.GroupsShown);
            List<Visual> shown = new List<Visual>();
            foreach (Visual visual in spec.Visuals) if (IsShown(groups, visual)) shown.Add(visual);
            foreach (Site site in spec.Sites)
            {
                Visual visual = new Visual { Id = -1 - site.Id, Body = site.Body, T_body_visual = site.T_body_site, Group = site.Group, Geometry = site.Geometry, Material = site.Material, Rgba = site.Rgba };
                if (IsShown(groups, visual)) shown.Add(visual);
            }
            List<string> keys = new List<string>(shown.Count);
            List<SceneLook> looks = new List<SceneLook>(shown.Count);
            foreach (Visual visual in shown)
            {
                SceneLook look = MakeLook(visual);
                looks.Add(look);
                keys.Add(MakeLookKey(look));
                if (bodies[visual.Body].IsMoving) continue;
                string key = keys[keys.Count - 1] + MakeGeometryKey(visual.Geometry);
                fixedCounts[key] = fixedCounts.TryGetValue(key, out int count) ? count + 1 : 1;
            }
            for (int i = 0; i < shown.Count; i++) AddVisual(shown[i], looks[i], keys[i]);
            return MergeInstances();
        }

        /// <summary>Return the texture that gives a material its colour, -1 for none.</summary>
        public static int FindColorTexture(SceneSpec spec, long material)
        {
            if (material < 0) return -1;
            foreach (TextureUse use in spec.Materials[material].Textures)
            {
                if ((use.Role == TextureRole.Rgb || use.Role == TextureRole.Rgba) && use.Texture >= 0) return (int)use.Texture;
            }
            return -1;
        }

        private bool IsShown(HashSet<long> groups, Visual visual)
        {
            if (!(visual.Rgba[3] > 0.0) || !groups.Contains(visual.Group)) return false;
            Double3 origin = bodies[visual.Body].T_world_body.Position;
            bool isUsable = ScenePlan.IsFinite(visual.Rgba) && IsDrawable(visual.T_body_visual.P) && ScenePlan.IsFinite(visual.T_body_visual.Q)
                && IsDrawable(visual.Geometry.Size) && IsDrawable(new[] { origin.X, origin.Y, origin.Z });
            if (!isUsable) UnusableCount++;
            return isUsable;
        }

        private static bool IsDrawable(double[] lengths)
        {
            foreach (double value in lengths) if (!(Math.Abs(value) <= MaxLength)) return false;
            return true;
        }

        private SceneLook MakeLook(Visual visual)
        {
            int texture = FindColorTexture(spec, visual.Material);
            TextureMapping mapping = TextureMapping.None;
            if (texture >= 0)
            {
                // As in MuJoCo, a cube does not lie on meshes with texture coordinates.
                bool isTextured = visual.Geometry.Mesh >= 0 && spec.Meshes[visual.Geometry.Mesh].Textured;
                mapping = spec.Textures[texture].Kind == TextureKind.Image ? TextureMapping.Map : isTextured ? TextureMapping.None : TextureMapping.Cube;
            }
            if (mapping != TextureMapping.None && plan.FindTextureLevel(texture) == null)
            {
                onProblem("the texture " + PairingLink.Quote(spec.Textures[texture].Name) + " is in a form that headsets cannot read");
                mapping = TextureMapping.None;
            }
            if (mapping == TextureMapping.None) texture = -1;
            bool isTransparent = visual.Rgba[3] < 1.0 || (texture >= 0 && spec.Textures[texture].Channels == 4);
            return new SceneLook((int)visual.Material, visual.Rgba, texture, mapping, isTransparent);
        }

        private void AddVisual(Visual visual, SceneLook look, string lookKey)
        {
            SceneBody body = bodies[visual.Body];
            RigidTransform pose = SceneDecoder.ToTransform(visual.T_body_visual);
            string geometryKey = MakeGeometryKey(visual.Geometry);
            double vertices = CountVertices(visual.Geometry);
            Cluster cluster = new Cluster { Body = body.IsMoving ? body.Id : World, Look = look, LookKey = lookKey };
            if (!body.IsMoving) pose = body.T_world_body * pose;
            bool isRepeated = !body.IsMoving && vertices >= MinInstancedVertices && fixedCounts[lookKey + geometryKey] > 1;
            if (look.IsTransparent || visual.Geometry.Kind == GeometryKind.Plane || vertices > MaxVertices || isRepeated)
            {
                clusters.Add(cluster);
                if (isRepeated)
                {
                    cluster.T_body_part = pose;
                    pose = RigidTransform.Identity;
                }
            }
            else
            {
                string key = cluster.Body.ToString(CultureInfo.InvariantCulture) + lookKey;
                if (open.TryGetValue(key, out Cluster known) && known.Vertices + vertices <= MaxMergedVertices) cluster = known;
                else
                {
                    open[key] = cluster;
                    clusters.Add(cluster);
                }
            }
            cluster.Vertices += vertices;
            cluster.Shapes.Add(new SceneShape(visual.Id, visual.Geometry, pose));
            cluster.Key.Append(geometryKey);
            Append(cluster.Key, pose);
        }

        /// <summary>Make parts of the clusters: those that are the same in other places are one.</summary>
        private List<ScenePart> MergeInstances()
        {
            List<List<Cluster>> alike = new List<List<Cluster>>();
            Dictionary<string, List<Cluster>> byKey = new Dictionary<string, List<Cluster>>();
            foreach (Cluster cluster in clusters)
            {
                string key = cluster.LookKey + cluster.Key;
                bool isAlone = cluster.Look.IsTransparent || cluster.Shapes[0].Geometry.Kind == GeometryKind.Plane;
                if (!isAlone && byKey.TryGetValue(key, out List<Cluster> others) && others.Count < MaxPlaces)
                {
                    others.Add(cluster);
                    continue;
                }
                List<Cluster> group = new List<Cluster> { cluster };
                alike.Add(group);
                if (!isAlone) byKey[key] = group;
            }
            List<ScenePart> parts = new List<ScenePart>(alike.Count);
            foreach (List<Cluster> group in alike)
            {
                ScenePlace[] places = new ScenePlace[group.Count];
                StringBuilder key = new StringBuilder(group[0].LookKey).Append(group[0].Key);
                for (int i = 0; i < places.Length; i++)
                {
                    places[i] = new ScenePlace(group[i].Body, group[i].T_body_part);
                    Append(key.Append('@').Append(places[i].Body.ToString(CultureInfo.InvariantCulture)), places[i].T_body_part);
                }
                parts.Add(new ScenePart(key.ToString(), group[0].Look, group[0].Shapes.ToArray(), places));
            }
            return parts;
        }

        private double CountVertices(Geometry geometry)
        {
            MeshLevel level = plan.FindLevel(geometry);
            return level != null ? level.Vertices : 3.0 * SceneLevels.CountTriangles(spec, geometry, 0);
        }

        // --- content, independent of indices in one specification ---

        private string MakeLookKey(SceneLook look)
        {
            StringBuilder key = new StringBuilder("look:");
            foreach (double value in look.Rgba) Append(key, value);
            key.Append((int)look.Mapping).Append(look.Material < 0 ? "" : MakeMaterialKey(look.Material));
            if (look.Texture >= 0) key.Append(plan.FindTextureLevel(look.Texture).Address).Append(spec.Textures[look.Texture].Colorspace);
            return key.Append(';').ToString();
        }

        private string MakeMaterialKey(int index)
        {
            if (materialKeys[index] != null) return materialKeys[index];
            Material material = spec.Materials[index];
            StringBuilder key = new StringBuilder("m");
            foreach (double value in new[] { material.Emission, material.Specular, material.Shininess, material.Reflectance, material.Metallic, material.Roughness, material.Repeat[0], material.Repeat[1] }) Append(key, value);
            return materialKeys[index] = key.Append(material.Uniform ? 'u' : '-').ToString();
        }

        private string MakeGeometryKey(Geometry geometry)
        {
            StringBuilder key = new StringBuilder("g").Append(geometry.Kind).Append(':');
            foreach (double value in geometry.Size) Append(key, value);
            if (geometry.Mesh >= 0) return key.Append(plan.FindLevel(geometry).Address).ToString();
            if (geometry.Hfield < 0) return key.ToString();
            HeightField field = spec.Hfields[geometry.Hfield];
            foreach (double value in field.Size) Append(key, value);
            return key.Append(field.Address).ToString();
        }

        private static void Append(StringBuilder key, RigidTransform pose)
        {
            Append(key, pose.Position.X);
            Append(key, pose.Position.Y);
            Append(key, pose.Position.Z);
            Append(key, pose.Rotation.W);
            Append(key, pose.Rotation.X);
            Append(key, pose.Rotation.Y);
            Append(key, pose.Rotation.Z);
        }

        private static void Append(StringBuilder key, double value)
        {
            key.Append(BitConverter.DoubleToInt64Bits(value).ToString("x", CultureInfo.InvariantCulture)).Append(',');
        }
    }
}
