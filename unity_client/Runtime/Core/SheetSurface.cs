// Points and normals of a deformable as a graphics card takes them, in Unity's axes. A port of web_client/src/core/sheet.ts, and
// tubes for ropes. Building a frame allocates nothing.
using System;
using System.Collections.Generic;

namespace IrisSession.Core
{
    /// <summary>How a deformable is drawn: as in `Deformable`.</summary>
    public readonly struct SheetLook
    {
        /// <summary>1: ropes, 2: a cloth, 3: the skin of a body.</summary>
        public readonly int Dim;

        /// <summary>Half the thickness of a cloth, or radius of a rope [m].</summary>
        public readonly float Radius;

        /// <summary>True for one normal a triangle.</summary>
        public readonly bool IsFlat;

        public SheetLook(int dim, double radius, bool isFlat)
        {
            Dim = dim;
            Radius = (float)radius;
            IsFlat = isFlat;
        }
    }

    /// <summary>Triangles of a deformable. A cloth has its thickness: both sides are `Radius` from the vertices, with a rim between.</summary>
    public abstract class DeformableSurface
    {
        /// <summary>Least radius of a rope [m]: thinner ones are not seen.</summary>
        private const float LeastRadiusM = 0.001f;

        /// <summary>Most points that are drawn: beyond it an asset is no deformable of this protocol.</summary>
        protected const int MaxPoints = 1 << 23;
        private readonly int vertexCount;
        private readonly float[] vertices;

        private protected DeformableSurface(int vertexCount)
        {
            this.vertexCount = vertexCount;
            vertices = new float[3 * vertexCount];
        }

        /// <summary>Three drawn points for each triangle, clockwise from outside.</summary>
        public int[] Indices { get; private protected set; }

        /// <summary>Place in the texture of every drawn point, two floats, to the right and up; null for none.</summary>
        public float[] Uv { get; private protected set; }

        /// <summary>Three floats for every drawn point, of the newest <see cref="Build"/>.</summary>
        public float[] Positions { get; private protected set; }

        public float[] Normals { get; private protected set; }

        /// <summary>Corners of the box around the points [m].</summary>
        public Float3 Low { get; private set; }

        public Float3 High { get; private set; }

        /// <summary>Return the surface of a deformable.</summary>
        /// <param name="elements">Vertices of each triangle, or of each piece of a rope.</param>
        /// <param name="uv">Two floats for each corner, to the right and down; null for none.</param>
        /// <exception cref="DecodeException">There are too many.</exception>
        public static DeformableSurface Make(SheetLook look, int vertexCount, int[] elements, float[] uv)
        {
            if (look.Dim == 1) return new RopeSurface(vertexCount, elements, Math.Max(look.Radius, LeastRadiusM));
            return new SheetSurface(look, vertexCount, elements, uv);
        }

        /// <summary>Write points and normals of vertices in the world and in the axes of the wire. False when they are of another one.</summary>
        public bool Build(float[] wire)
        {
            if (wire.Length != vertices.Length) return false;
            UnityAxes.PointsToUnity(wire, vertices, vertexCount);
            Place(vertices);
            float lowX = float.MaxValue, lowY = float.MaxValue, lowZ = float.MaxValue;
            float highX = float.MinValue, highY = float.MinValue, highZ = float.MinValue;
            for (int i = 0; i < Positions.Length; i += 3)
            {
                lowX = Math.Min(lowX, Positions[i]);
                lowY = Math.Min(lowY, Positions[i + 1]);
                lowZ = Math.Min(lowZ, Positions[i + 2]);
                highX = Math.Max(highX, Positions[i]);
                highY = Math.Max(highY, Positions[i + 1]);
                highZ = Math.Max(highZ, Positions[i + 2]);
            }
            Low = new Float3(lowX, lowY, lowZ);
            High = new Float3(highX, highY, highZ);
            return true;
        }

        private protected abstract void Place(float[] p);

        private protected static float Measure(float x, float y, float z)
        {
            float length = (float)Math.Sqrt(x * x + y * y + z * z);
            return length > 0f ? length : 1f;
        }
    }

    /// <summary>A cloth, or the skin of a body.</summary>
    internal sealed class SheetSurface : DeformableSurface
    {
        private readonly float radius;
        private readonly bool isFlat;

        // Drawn points of one side, and where the rim begins.
        private readonly int upper;
        private readonly int rimStart;

        // Places in the array of vertices: of the corners of the triangles, of the points of one side, of those of the rim.
        private readonly int[] corners;
        private readonly int[] from;
        private readonly int[] rimFrom;
        private readonly float[] offset;
        private readonly float[] smooth;

        public SheetSurface(SheetLook look, int vertexCount, int[] elements, float[] uv) : base(vertexCount)
        {
            bool isThick = look.Dim == 2 && look.Radius > 0f;
            radius = isThick ? look.Radius : 0f;
            isFlat = look.IsFlat;
            corners = Array.ConvertAll(elements, vertex => 3 * vertex);
            UnityAxes.FlipWinding(corners);
            List<int> vertex = new List<int>();
            List<float> coordinate = new List<float>();
            List<int> index = new List<int>();
            Dictionary<(int, float, float), int> known = new Dictionary<(int, float, float), int>();
            for (int c = 0; c < corners.Length; c++)
            {
                int corner = FindCorner(c);
                float u = uv == null ? 0f : uv[2 * corner], v = uv == null ? 0f : 1f - uv[2 * corner + 1];
                (int, float, float) key = (corners[c], u, v);
                if (!isFlat && known.TryGetValue(key, out int before))
                {
                    index.Add(before);
                    continue;
                }
                known[key] = vertex.Count;
                index.Add(vertex.Count);
                vertex.Add(corners[c]);
                coordinate.Add(u);
                coordinate.Add(v);
            }
            upper = vertex.Count;
            if (isThick)
            {
                for (int c = 0, n = index.Count; c + 2 < n; c += 3)
                {
                    index.Add(upper + index[c]);
                    index.Add(upper + index[c + 2]);
                    index.Add(upper + index[c + 1]);
                }
                coordinate.AddRange(coordinate.ToArray());
            }
            rimStart = isThick ? 2 * upper : upper;
            List<int> rim = new List<int>();
            List<float> distance = new List<float>();
            if (isThick) AddRim(rim, distance, index, coordinate, uv);
            int count = rimStart + rim.Count;
            if (count > MaxPoints) throw new DecodeException("a deformable of " + count + " drawn points");
            Indices = index.ToArray();
            Uv = uv == null ? null : coordinate.ToArray();
            from = vertex.ToArray();
            rimFrom = rim.ToArray();
            offset = distance.ToArray();
            smooth = new float[3 * vertexCount];
            Positions = new float[3 * count];
            Normals = new float[3 * count];
        }

        /// <summary>Return the corner of the asset that is at `c` after the winding was reversed.</summary>
        private static int FindCorner(int c) { return c % 3 == 0 ? c : c % 3 == 1 ? c + 1 : c - 1; }

        /// <summary>Add the points of the rim: edges of one triangle only, in its winding. They share nothing.</summary>
        private void AddRim(List<int> rim, List<float> distance, List<int> index, List<float> coordinate, float[] uv)
        {
            Dictionary<(int, int), int> edges = new Dictionary<(int, int), int>();
            for (int c = 0; c < corners.Length; c++)
            {
                (int, int) key = MakeEdge(c);
                edges[key] = edges.ContainsKey(key) ? -1 : c;
            }
            int[] turns = { 0, 0, 1, 0, 1, 1 };
            int[] signs = { 1, -1, -1, 1, -1, 1 };
            for (int c = 0; c < corners.Length; c++)
            {
                if (edges[MakeEdge(c)] != c) continue;
                for (int k = 0; k < turns.Length; k++)
                {
                    int at = turns[k] == 0 ? c : Next(c);
                    index.Add(rimStart + rim.Count);
                    rim.Add(corners[at]);
                    distance.Add(signs[k] * radius);
                    coordinate.Add(uv == null ? 0f : uv[2 * FindCorner(at)]);
                    coordinate.Add(uv == null ? 0f : 1f - uv[2 * FindCorner(at) + 1]);
                }
            }
        }

        private static int Next(int c) { return c % 3 == 2 ? c - 2 : c + 1; }

        private (int, int) MakeEdge(int c)
        {
            int a = corners[c];
            int b = corners[Next(c)];
            return a < b ? (a, b) : (b, a);
        }

        private protected override void Place(float[] p)
        {
            AddUpNormals(p);
            PlaceSides(p);
            for (int i = 0, at = 3 * rimStart; i < offset.Length; i++)
            {
                for (int k = 0; k < 3; k++, at++) Positions[at] = p[rimFrom[i] + k] + offset[i] * smooth[rimFrom[i] + k];
            }
            for (int i = isFlat ? 0 : rimStart; i < Positions.Length / 3; i += 3) SetFlatNormal(i, i >= upper && i < rimStart ? -1f : 1f);
        }

        /// <summary>Write the unit normals of vertices: the sum over their triangles, weighed by area.</summary>
        private void AddUpNormals(float[] p)
        {
            Array.Clear(smooth, 0, smooth.Length);
            for (int c = 0; c < corners.Length; c += 3)
            {
                int a = corners[c], b = corners[c + 1], d = corners[c + 2];
                float ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
                float vx = p[d] - p[a], vy = p[d + 1] - p[a + 1], vz = p[d + 2] - p[a + 2];
                float x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
                smooth[a] += x;
                smooth[a + 1] += y;
                smooth[a + 2] += z;
                smooth[b] += x;
                smooth[b + 1] += y;
                smooth[b + 2] += z;
                smooth[d] += x;
                smooth[d + 1] += y;
                smooth[d + 2] += z;
            }
            for (int i = 0; i < smooth.Length; i += 3)
            {
                float length = Measure(smooth[i], smooth[i + 1], smooth[i + 2]);
                smooth[i] /= length;
                smooth[i + 1] /= length;
                smooth[i + 2] /= length;
            }
        }

        private void PlaceSides(float[] p)
        {
            int size = 3 * from.Length;
            for (int i = 0, at = 0; i < from.Length; i++)
            {
                for (int k = 0; k < 3; k++, at++)
                {
                    float normal = smooth[from[i] + k];
                    Positions[at] = p[from[i] + k] + radius * normal;
                    Normals[at] = normal;
                    if (radius == 0f) continue;
                    Positions[size + at] = p[from[i] + k] - radius * normal;
                    Normals[size + at] = -normal;
                }
            }
        }

        /// <summary>Write the normal of the triangle of three points. `sign`: -1 where it is drawn in the other order.</summary>
        private void SetFlatNormal(int point, float sign)
        {
            int a = 3 * point;
            float[] p = Positions;
            float ux = p[a + 3] - p[a], uy = p[a + 4] - p[a + 1], uz = p[a + 5] - p[a + 2];
            float vx = p[a + 6] - p[a], vy = p[a + 7] - p[a + 1], vz = p[a + 8] - p[a + 2];
            float x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
            float length = sign * Measure(x, y, z);
            for (int at = a; at < a + 9; at += 3)
            {
                Normals[at] = x / length;
                Normals[at + 1] = y / length;
                Normals[at + 2] = z / length;
            }
        }
    }

    /// <summary>Ropes: an open tube for each piece.</summary>
    internal sealed class RopeSurface : DeformableSurface
    {
        private const int Sides = 8;
        private static readonly float[] Cosines = Tabulate(Math.Cos);
        private static readonly float[] Sines = Tabulate(Math.Sin);
        private readonly int[] ends;
        private readonly float radius;

        public RopeSurface(int vertexCount, int[] elements, float radius) : base(vertexCount)
        {
            this.radius = radius;
            ends = Array.ConvertAll(elements, vertex => 3 * vertex);
            int pieces = ends.Length / 2;
            if (2L * Sides * pieces > MaxPoints) throw new DecodeException("a rope of " + pieces + " pieces");
            Positions = new float[3 * 2 * Sides * pieces];
            Normals = new float[Positions.Length];
            Indices = new int[6 * Sides * pieces];
            for (int piece = 0, at = 0; piece < pieces; piece++)
            {
                for (int side = 0; side < Sides; side++)
                {
                    int a = 2 * (piece * Sides + side), b = 2 * (piece * Sides + (side + 1) % Sides);
                    int[] corners = { a, b, a + 1, b, b + 1, a + 1 };
                    foreach (int corner in corners) Indices[at++] = corner;
                }
            }
        }

        private static float[] Tabulate(Func<double, double> function)
        {
            float[] values = new float[Sides];
            for (int i = 0; i < Sides; i++) values[i] = (float)function(2.0 * Math.PI * i / Sides);
            return values;
        }

        private protected override void Place(float[] p)
        {
            for (int piece = 0, at = 0; piece < ends.Length / 2; piece++)
            {
                int a = ends[2 * piece], b = ends[2 * piece + 1];
                float x = p[b] - p[a], y = p[b + 1] - p[a + 1], z = p[b + 2] - p[a + 2];
                float length = Measure(x, y, z);
                x /= length;
                y /= length;
                z /= length;
                // Two directions across: from the axis that the piece is farthest from. `e` = axis x piece, `f` = piece x e.
                bool isNearX = Math.Abs(x) > 0.6f;
                float ex = isNearX ? z : 0f, ey = isNearX ? 0f : -z, ez = isNearX ? -x : y;
                float across = Measure(ex, ey, ez);
                ex /= across;
                ey /= across;
                ez /= across;
                float fx = y * ez - z * ey, fy = z * ex - x * ez, fz = x * ey - y * ex;
                for (int side = 0; side < Sides; side++)
                {
                    float nx = Cosines[side] * ex + Sines[side] * fx;
                    float ny = Cosines[side] * ey + Sines[side] * fy;
                    float nz = Cosines[side] * ez + Sines[side] * fz;
                    for (int end = a, k = 0; k < 2; end = b, k++, at += 3)
                    {
                        Positions[at] = p[end] + radius * nx;
                        Positions[at + 1] = p[end + 1] + radius * ny;
                        Positions[at + 2] = p[end + 2] + radius * nz;
                        Normals[at] = nx;
                        Normals[at + 1] = ny;
                        Normals[at + 2] = nz;
                    }
                }
            }
        }
    }
}
