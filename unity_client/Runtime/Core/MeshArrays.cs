// Triangles of shapes: of assets, and of primitives and height fields by the formulas of docs/scene.md. A port of
// iris_session/scene/shapes.py; right-handed, in the frame of the shape [m]. Round shapes have as many slices and stacks as MuJoCo's,
// so that silhouettes agree.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Triangles with normals. Counter-clockwise from outside.</summary>
    public sealed class MeshArrays
    {
        private const int Slices = 28;
        private const int Stacks = 16;

        /// <summary>Half the side of an infinite plane where it is drawn as a finite one [m].</summary>
        public const double Endless = 50.0;

        /// <summary>Three floats for each vertex.</summary>
        public readonly float[] Positions;
        public readonly float[] Normals;

        /// <summary>Two for each vertex: to the right and down; null for none.</summary>
        public readonly float[] Uv;

        /// <summary>Four bytes for each vertex, red, green, blue, alpha; null for none.</summary>
        public readonly byte[] Colors;
        public readonly int[] Indices;

        internal MeshArrays(float[] positions, float[] normals, float[] uv, byte[] colors, int[] indices)
        {
            Positions = positions;
            Normals = normals;
            Uv = uv;
            Colors = colors;
            Indices = indices;
        }

        public int VertexCount { get { return Positions.Length / 3; } }

        /// <summary>Return the mesh of an asset.</summary>
        /// <exception cref="DecodeException">It is none.</exception>
        public static MeshArrays FromAsset(ArrayAsset asset)
        {
            if (asset.Kind != ArrayKind.Mesh) throw new DecodeException("an asset of another kind where a mesh is needed");
            float[] positions = asset.RequireFloats("position", ArrayAsset.Any, 3);
            int count = positions.Length / 3;
            float[] normals = asset.RequireFloats("normal", count, 3);
            float[] uv = asset.Find("uv") == null ? null : asset.RequireFloats("uv", count, 2);
            byte[] colors = asset.Find("color") == null ? null : asset.RequireBytes("color", count, 4);
            int[] indices = asset.RequireIndices("index", count, ArrayAsset.Any, 3);
            CheckFinite(positions);
            CheckFinite(normals);
            if (uv != null) CheckFinite(uv);
            return new MeshArrays(positions, normals, uv, colors, indices);
        }

        /// <summary>Return the mesh of a shape that needs no asset. Kinds that are not known are boxes of their size.</summary>
        public static MeshArrays FromPrimitive(Geometry geometry)
        {
            double x = geometry.Size[0];
            double y = geometry.Size[1];
            double z = geometry.Size[2];
            Corners corners = new Corners();
            switch (geometry.Kind)
            {
                case GeometryKind.Plane:
                    double a = x > 0.0 ? x : Endless;
                    double b = y > 0.0 ? y : Endless;
                    corners.AddQuad(new Double3(-a, -b, 0), new Double3(a, -b, 0), new Double3(a, b, 0), new Double3(-a, b, 0));
                    break;
                case GeometryKind.Sphere:
                case GeometryKind.Ellipsoid:
                    double[] arc = MakeArc(Stacks + 1, -1.0, 1.0, 0.0);
                    corners.Revolve(arc, arc, x, y, z);
                    break;
                case GeometryKind.Cylinder:
                    corners.Revolve(new double[] { 0, -1, 1, -1, 1, -1, 1, 1, 1, 1, 0, 1 }, new double[] { 0, -1, 0, -1, 1, 0, 1, 0, 0, 1, 0, 1 }, x, y, z);
                    break;
                case GeometryKind.Capsule:
                    double middle = x > 0.0 ? z / x : 0.0;
                    double[] profile = Join(MakeArc(Stacks / 2 + 1, -1.0, 0.0, -middle), MakeArc(Stacks / 2 + 1, 0.0, 1.0, middle));
                    corners.Revolve(profile, Join(MakeArc(Stacks / 2 + 1, -1.0, 0.0, 0.0), MakeArc(Stacks / 2 + 1, 0.0, 1.0, 0.0)), x, x, x);
                    break;
                default:
                    AddBox(corners, x, y, z);
                    break;
            }
            return corners.ToMesh();
        }

        /// <summary>Return the surface of a height field, its four walls and its floor.</summary>
        /// <param name="elevation">Rows along y, columns along x, in 0..1: the array of its asset.</param>
        /// <exception cref="DecodeException">The elevations do not fit.</exception>
        public static MeshArrays FromHeightField(HeightField field, float[] elevation)
        {
            if (field.Rows < 2 || field.Columns < 2 || elevation.Length / field.Columns != field.Rows || elevation.Length % field.Columns != 0) throw new DecodeException("a height field of another size than its asset");
            CheckFinite(elevation);
            int rows = (int)field.Rows;
            int columns = (int)field.Columns;
            double[] size = field.Size;
            Double3 At(int r, int c, double height)
            {
                return new Double3((2.0 * c / (columns - 1) - 1.0) * size[0], (2.0 * r / (rows - 1) - 1.0) * size[1], height);
            }

            Double3 Top(int r, int c) { return At(r, c, elevation[r * columns + c] * size[2]); }

            Corners corners = new Corners();
            for (int r = 0; r + 1 < rows; r++)
            {
                for (int c = 0; c + 1 < columns; c++)
                {
                    corners.AddTriangle(Top(r + 1, c), Top(r, c), Top(r + 1, c + 1));
                    corners.AddTriangle(Top(r, c), Top(r, c + 1), Top(r + 1, c + 1));
                }
            }
            void AddWall(int r, int c, int nextR, int nextC)
            {
                corners.AddQuad(At(r, c, -size[3]), At(nextR, nextC, -size[3]), Top(nextR, nextC), Top(r, c));
            }

            for (int c = 0; c + 1 < columns; c++)
            {
                AddWall(0, c, 0, c + 1);
                AddWall(rows - 1, columns - 1 - c, rows - 1, columns - 2 - c);
            }
            for (int r = 0; r + 1 < rows; r++)
            {
                AddWall(r, columns - 1, r + 1, columns - 1);
                AddWall(rows - 1 - r, 0, rows - 2 - r, 0);
            }
            corners.AddQuad(At(0, 0, -size[3]), At(rows - 1, 0, -size[3]), At(rows - 1, columns - 1, -size[3]), At(0, columns - 1, -size[3]));
            return corners.ToMesh();
        }

        internal static void CheckFinite(float[] values)
        {
            foreach (float value in values) if (float.IsNaN(value) || float.IsInfinity(value)) throw new DecodeException("a number of a mesh is not finite");
        }

        /// <summary>Return the mesh with three vertices of its own for each triangle.</summary>
        internal MeshArrays SplitCorners()
        {
            float[] positions = new float[3 * Indices.Length];
            float[] normals = new float[3 * Indices.Length];
            int[] indices = new int[Indices.Length];
            for (int i = 0; i < indices.Length; i++)
            {
                Array.Copy(Positions, 3 * Indices[i], positions, 3 * i, 3);
                Array.Copy(Normals, 3 * Indices[i], normals, 3 * i, 3);
                indices[i] = i;
            }
            return new MeshArrays(positions, normals, null, null, indices);
        }

        internal MeshArrays WithUv(float[] uv) { return new MeshArrays(Positions, Normals, uv, Colors, Indices); }

        private static void AddBox(Corners corners, double x, double y, double z)
        {
            Double3 P(int i, int j, int k) { return new Double3(i * x, j * y, k * z); }

            corners.AddQuad(P(-1, -1, 1), P(1, -1, 1), P(1, 1, 1), P(-1, 1, 1));
            corners.AddQuad(P(-1, 1, -1), P(1, 1, -1), P(1, -1, -1), P(-1, -1, -1));
            corners.AddQuad(P(1, -1, -1), P(1, 1, -1), P(1, 1, 1), P(1, -1, 1));
            corners.AddQuad(P(-1, 1, -1), P(-1, -1, -1), P(-1, -1, 1), P(-1, 1, 1));
            corners.AddQuad(P(-1, -1, -1), P(1, -1, -1), P(1, -1, 1), P(-1, -1, 1));
            corners.AddQuad(P(1, 1, -1), P(-1, 1, -1), P(-1, 1, 1), P(1, 1, 1));
        }

        /// <summary>Return (distance from the axis, height) on a half circle of radius 1, from `low` to `high` quarter turns.</summary>
        private static double[] MakeArc(int points, double low, double high, double lift)
        {
            double[] arc = new double[2 * points];
            for (int i = 0; i < points; i++)
            {
                double angle = (low + (high - low) * i / (points - 1)) * Math.PI / 2.0;
                arc[2 * i] = Math.Cos(angle);
                arc[2 * i + 1] = Math.Sin(angle) + lift;
            }
            return arc;
        }

        private static double[] Join(double[] a, double[] b)
        {
            double[] joined = new double[a.Length + b.Length];
            a.CopyTo(joined, 0);
            b.CopyTo(joined, a.Length);
            return joined;
        }

        /// <summary>Collects triangles, three corners each.</summary>
        private sealed class Corners
        {
            private readonly List<float> positions = new List<float>();
            private readonly List<float> normals = new List<float>();

            public void AddQuad(Double3 a, Double3 b, Double3 c, Double3 d)
            {
                AddTriangle(a, b, c);
                AddTriangle(a, c, d);
            }

            public void AddTriangle(Double3 a, Double3 b, Double3 c)
            {
                Double3 normal = Normalize(Double3.Cross(b - a, c - a));
                AddCorner(a, normal);
                AddCorner(b, normal);
                AddCorner(c, normal);
            }

            /// <summary>Revolve a profile (distance, height), from below, around z and scale it; `across`: normals before scaling.</summary>
            public void Revolve(double[] profile, double[] across, double x, double y, double z)
            {
                Double3 Point(int i, int j)
                {
                    double angle = j % Slices * 2.0 * Math.PI / Slices;
                    return new Double3(profile[2 * i] * Math.Cos(angle) * x, profile[2 * i] * Math.Sin(angle) * y, profile[2 * i + 1] * z);
                }

                Double3 Normal(int i, int j)
                {
                    double angle = j % Slices * 2.0 * Math.PI / Slices;
                    return Normalize(new Double3(Divide(across[2 * i] * Math.Cos(angle), x), Divide(across[2 * i] * Math.Sin(angle), y), Divide(across[2 * i + 1], z)));
                }

                double least = 1e-12 * Math.Max(Math.Abs(x * y), Math.Max(Math.Abs(y * z), Math.Abs(x * z))) / (Slices * Stacks);
                void Add(int i, int j, int k, int l, int m, int n)
                {
                    Double3 a = Point(i, j);
                    Double3 b = Point(k, l);
                    Double3 c = Point(m, n);
                    if (!(Double3.Cross(b - a, c - a).Length > least)) return; // at poles, and between the parts of a profile
                    AddCorner(a, Normal(i, j));
                    AddCorner(b, Normal(k, l));
                    AddCorner(c, Normal(m, n));
                }

                for (int i = 0; 2 * i + 2 < profile.Length; i++)
                {
                    for (int j = 0; j < Slices; j++)
                    {
                        Add(i, j, i, j + 1, i + 1, j + 1);
                        Add(i, j, i + 1, j + 1, i + 1, j);
                    }
                }
            }

            public MeshArrays ToMesh()
            {
                int[] indices = new int[positions.Count / 3];
                for (int i = 0; i < indices.Length; i++) indices[i] = i;
                return new MeshArrays(positions.ToArray(), normals.ToArray(), null, null, indices);
            }

            private void AddCorner(Double3 position, Double3 normal)
            {
                positions.Add((float)position.X);
                positions.Add((float)position.Y);
                positions.Add((float)position.Z);
                normals.Add((float)normal.X);
                normals.Add((float)normal.Y);
                normals.Add((float)normal.Z);
            }

            private static double Divide(double value, double by) { return by != 0.0 ? value / by : value; }

            private static Double3 Normalize(Double3 v)
            {
                double length = v.Length;
                return length > 0.0 ? (1.0 / length) * v : v;
            }
        }
    }
}
