// Levels of detail that fit what a headset can draw. A port of iris_session/scene/budget.py: what loses least detail per triangle
// saved is coarsened first.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Limits of what is drawn; 0 means no limit.</summary>
    public readonly struct SceneBudget
    {
        /// <summary>Where a Quest 3 begins to struggle.</summary>
        public static readonly SceneBudget Quest3 = new SceneBudget(750_000, 700L << 20, 200, 100_000, 2048 * 2048);

        /// <summary>An estimate for HoloLens 2, never measured on one.</summary>
        public static readonly SceneBudget HoloLens2 = new SceneBudget(100_000, 200L << 20, 50, 20_000, 1024 * 1024);

        public readonly long Triangles;

        /// <summary>Memory of textures on the graphics card [bytes].</summary>
        public readonly long TextureBytes;

        /// <summary>Draw calls.</summary>
        public readonly int Objects;

        /// <summary>Points of all clouds together.</summary>
        public readonly int Points;

        /// <summary>Pixels of one texture that has coarser levels: it goes to the graphics card on the engine's thread, in one frame.</summary>
        public readonly long TexturePixels;

        public SceneBudget(long triangles, long textureBytes, int objects, int points, long texturePixels = 0)
        {
            Triangles = triangles;
            TextureBytes = textureBytes;
            Objects = objects;
            Points = points;
            TexturePixels = texturePixels;
        }

        /// <summary>Return the same budget with another number of objects.</summary>
        public SceneBudget WithObjects(int objects) { return new SceneBudget(Triangles, TextureBytes, objects, Points, TexturePixels); }
    }

    /// <summary>Levels chosen for a budget.</summary>
    public sealed class SceneLevels
    {
        public readonly int[] Meshes;
        public readonly int[] Textures;

        /// <summary>Ids of visuals to leave out, the smallest ones.</summary>
        public readonly HashSet<long> Hidden = new HashSet<long>();

        /// <summary>Cost of the rest. Floating: what a specification claims fits no integer.</summary>
        public double Triangles { get; private set; }

        public double TextureBytes { get; private set; }

        public int Objects { get; private set; }

        /// <summary>False when even the coarsest levels exceed the budget.</summary>
        public bool Fits { get; private set; }

        private SceneLevels(SceneSpec spec)
        {
            Meshes = new int[spec.Meshes.Length];
            Textures = new int[spec.Textures.Length];
        }

        /// <summary>Choose the finest levels that fit. Deformables have no levels and are never left out.</summary>
        public static SceneLevels Choose(SceneSpec spec, SceneBudget budget)
        {
            SceneLevels chosen = new SceneLevels(spec);
            HashSet<long> groups = new HashSet<long>(spec.GroupsShown);
            int bending = 0;
            double besides = 0.0;
            foreach (Deformable part in spec.Deformables)
            {
                if (!(part.Rgba[3] > 0.0) || !groups.Contains(part.Group)) continue;
                bending++;
                if (part.Dim > 1) besides += part.Elements;
            }
            List<Visual> drawn = new List<Visual>();
            foreach (Visual visual in spec.Visuals) if (visual.Rgba[3] > 0.0 && groups.Contains(visual.Group)) drawn.Add(visual);
            if (budget.Objects > 0) chosen.HideSmallest(spec, drawn, Math.Max(1, budget.Objects - bending));
            int[] uses = new int[spec.Meshes.Length];
            int kept = 0;
            foreach (Visual visual in drawn)
            {
                if (chosen.Hidden.Contains(visual.Id)) continue;
                kept++;
                if (visual.Geometry.Mesh >= 0) uses[visual.Geometry.Mesh]++;
                else besides += CountTriangles(spec, visual.Geometry, 0);
            }
            chosen.Triangles = ChooseMeshes(spec, uses, budget.Triangles, besides, chosen.Meshes);
            chosen.TextureBytes = ChooseTextures(spec, budget, chosen.Textures);
            chosen.Objects = kept + bending;
            chosen.Fits = IsWithin(chosen.Triangles, budget.Triangles) && IsWithin(chosen.TextureBytes, budget.TextureBytes) && IsWithin(chosen.Objects, budget.Objects);
            return chosen;
        }

        /// <summary>Return the triangles of a shape at a usual tessellation.</summary>
        public static double CountTriangles(SceneSpec spec, Geometry geometry, int level)
        {
            if (geometry.Mesh >= 0)
            {
                MeshLevel[] levels = spec.Meshes[geometry.Mesh].Levels;
                return levels[Math.Min(level, levels.Length - 1)].Triangles;
            }
            if (geometry.Hfield >= 0)
            {
                HeightField field = spec.Hfields[geometry.Hfield];
                return 2.0 * Math.Max(0, field.Rows - 1) * Math.Max(0, field.Columns - 1);
            }
            switch (geometry.Kind)
            {
                case GeometryKind.Plane: return 2;
                case GeometryKind.Box: return 12;
                case GeometryKind.Sphere:
                case GeometryKind.Ellipsoid: return 960;
                case GeometryKind.Cylinder: return 128;
                case GeometryKind.Capsule: return 1_024;
                default: return 0;
            }
        }

        /// <summary>Return the largest side of a shape [m]; planes count as infinitely large.</summary>
        public static double MeasureSize(SceneSpec spec, Geometry geometry)
        {
            if (geometry.Kind == GeometryKind.Plane) return double.PositiveInfinity;
            if (geometry.Mesh >= 0) return LongestSide(spec.Meshes[geometry.Mesh]);
            double caps = geometry.Kind == GeometryKind.Capsule ? geometry.Size[0] : 0.0;
            return 2.0 * (Math.Max(geometry.Size[0], Math.Max(geometry.Size[1], geometry.Size[2])) + caps);
        }

        private static bool IsWithin(double used, long limit) { return limit == 0 || used <= limit; }

        private static double LongestSide(Mesh mesh)
        {
            return Math.Max(mesh.High[0] - mesh.Low[0], Math.Max(mesh.High[1] - mesh.Low[1], mesh.High[2] - mesh.Low[2]));
        }

        private void HideSmallest(SceneSpec spec, List<Visual> drawn, int objects)
        {
            if (drawn.Count <= objects) return;
            double[] sizes = new double[drawn.Count];
            int[] order = new int[drawn.Count];
            for (int i = 0; i < order.Length; i++)
            {
                sizes[i] = MeasureSize(spec, drawn[i].Geometry);
                order[i] = i;
            }
            Array.Sort(order, (a, b) => sizes[a] != sizes[b] ? sizes[a].CompareTo(sizes[b]) : a.CompareTo(b));
            for (int i = 0; i < drawn.Count - objects; i++) Hidden.Add(drawn[order[i]].Id);
        }

        private static double ChooseMeshes(SceneSpec spec, int[] uses, long limit, double besides, int[] levels)
        {
            double[][] costs = new double[spec.Meshes.Length][];
            double[][] losses = new double[spec.Meshes.Length][];
            for (int m = 0; m < costs.Length; m++)
            {
                Mesh mesh = spec.Meshes[m];
                costs[m] = new double[mesh.Levels.Length];
                losses[m] = new double[mesh.Levels.Length - 1];
                for (int k = 0; k < mesh.Levels.Length; k++)
                {
                    costs[m][k] = (double)uses[m] * mesh.Levels[k].Triangles;
                    if (k == 0) continue;
                    double saved = costs[m][k - 1] - costs[m][k];
                    losses[m][k - 1] = saved > 0.0 ? (mesh.Levels[k].MaxErrorM + 1e-9) / Math.Max(LongestSide(mesh), 1e-6) / saved : 0.0;
                }
            }
            return Coarsen(costs, losses, limit, besides, levels);
        }

        private static double ChooseTextures(SceneSpec spec, SceneBudget budget, int[] levels)
        {
            double[][] costs = new double[spec.Textures.Length][];
            double[][] losses = new double[spec.Textures.Length][];
            for (int t = 0; t < costs.Length; t++)
            {
                Texture texture = spec.Textures[t];
                costs[t] = new double[texture.Levels.Length];
                losses[t] = new double[texture.Levels.Length - 1];
                for (int k = 0; k < costs[t].Length; k++) costs[t][k] = MeasureMemory(texture, texture.Levels[k]);
                for (int k = 0; k < losses[t].Length; k++) losses[t][k] = -costs[t][k];
                while (levels[t] < losses[t].Length && !IsWithin(CountPixels(texture, texture.Levels[levels[t]]), budget.TexturePixels)) levels[t]++;
            }
            return Coarsen(costs, losses, budget.TextureBytes, 0.0, levels);
        }

        /// <summary>Bytes on a graphics card: four a pixel, and a third more for mipmaps.</summary>
        private static double MeasureMemory(Texture texture, TextureLevel level)
        {
            return Math.Floor(CountPixels(texture, level) * 4.0 * 4.0 / 3.0);
        }

        private static double CountPixels(Texture texture, TextureLevel level)
        {
            return (double)level.Width * level.Height * (texture.Kind == TextureKind.Image ? 1.0 : 6.0);
        }

        /// <summary>
        /// Choose the level of each thing, and return the cost of all with `besides`: at most `limit` (0: none) if that can be.
        /// </summary>
        /// <param name="losses">Of each step to a coarser level; the step that loses least comes first, 0 is not taken.</param>
        /// <param name="levels">Of each thing: where it begins, and what is chosen.</param>
        private static double Coarsen(double[][] costs, double[][] losses, long limit, double besides, int[] levels)
        {
            double total = besides;
            SortedSet<Step> queue = new SortedSet<Step>(StepOrder.Only);
            for (int k = 0; k < costs.Length; k++)
            {
                total += costs[k][levels[k]];
                AddStep(queue, losses, k, levels[k]);
            }
            while (limit > 0 && total > limit && queue.Count > 0)
            {
                Step step = queue.Min;
                queue.Remove(step);
                int level = levels[step.Index]++;
                total += costs[step.Index][level + 1] - costs[step.Index][level];
                AddStep(queue, losses, step.Index, level + 1);
            }
            return total;
        }

        private static void AddStep(SortedSet<Step> queue, double[][] losses, int index, int level)
        {
            if (level >= losses[index].Length) return;
            double loss = losses[index][level];
            if (loss != 0.0 && !double.IsNaN(loss)) queue.Add(new Step(loss, index));
        }

        private readonly struct Step
        {
            public readonly double Loss;
            public readonly int Index;

            public Step(double loss, int index)
            {
                Loss = loss;
                Index = index;
            }
        }

        private sealed class StepOrder : IComparer<Step>
        {
            public static readonly StepOrder Only = new StepOrder();

            public int Compare(Step a, Step b) { return a.Loss != b.Loss ? a.Loss.CompareTo(b.Loss) : a.Index.CompareTo(b.Index); }
        }
    }
}
