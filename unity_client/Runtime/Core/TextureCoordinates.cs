// Texture coordinates and cube directions of every geometry, by the formulas of docs/scene.md. A port of iris_session/scene/shapes.py
// and, for cubes, of web_client/src/view/shapes.ts.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Computes where a texture lies on a mesh.</summary>
    public static class TextureCoordinates
    {
        /// <summary>Distance from the axis, in radii, below which the angle around it is undefined.</summary>
        private const double Pole = 1e-6;

        /// <summary>Return the mesh of a geometry with the texture coordinates that a material gives it for 2d textures.</summary>
        public static MeshArrays Add(MeshArrays mesh, Geometry geometry, Material material)
        {
            double[] times = { material.Repeat[0], material.Repeat[1] };
            if (material.Uniform)
            {
                times[0] *= geometry.Size[0];
                times[1] *= geometry.Size[1];
            }
            if (mesh.Uv != null) return mesh.WithUv(Scale(mesh.Uv, times));
            if (geometry.Mesh >= 0 || geometry.Hfield >= 0) return mesh.WithUv(ProjectAlongZ(mesh.Positions, geometry, material));
            MeshArrays flat = mesh.SplitCorners();
            float[] uv = Scale(ComputeShape(flat, geometry), times);
            if (geometry.Kind != GeometryKind.Plane) return flat.WithUv(uv);
            float[] projected = ProjectAlongZ(flat.Positions, geometry, material); // along axes on which it has no end
            for (int i = 0; i < uv.Length; i++) if (!(geometry.Size[i % 2] > 0.0)) uv[i] = projected[i];
            return flat.WithUv(uv);
        }

        /// <summary>Return the direction by which each vertex samples a cube texture, three floats each; `mesh` becomes the one they are of.</summary>
        public static float[] ComputeCubeDirections(ref MeshArrays mesh, Geometry geometry, Material material, HeightField field)
        {
            double[] scale = ScaleDirection(geometry, material, field);
            bool isCapsule = geometry.Kind == GeometryKind.Capsule && geometry.Mesh < 0;
            if (isCapsule) mesh = mesh.SplitCorners(); // caps and middle differ where they meet
            float[] directions = new float[mesh.Positions.Length];
            for (int i = 0; i < directions.Length; i++) directions[i] = (float)(mesh.Positions[i] * scale[i % 3]);
            if (!isCapsule) return directions;
            double radius = geometry.Size[0];
            double half = geometry.Size[2];
            double stretch = material.Uniform ? half : 1.0;
            for (int t = 0; t < mesh.VertexCount; t += 3)
            {
                double end = FindCap(mesh.Positions, t, half);
                for (int k = t; end != 0.0 && k < t + 3; k++) directions[3 * k + 2] = (float)(((mesh.Positions[3 * k + 2] - end * half) / radius + end) * stretch);
            }
            return directions;
        }

        private static double[] ScaleDirection(Geometry geometry, Material material, HeightField field)
        {
            double[] size = geometry.Size;
            if (geometry.Kind == GeometryKind.Plane) return material.Uniform && (size[0] != 0.0 || size[1] != 0.0) ? new[] { size[0], size[1], 0.0 } : new[] { 1.0, 1.0, 0.0 };
            if (field != null) return material.Uniform ? new[] { size[0], size[1], 0.25 * field.Size[2] + 0.5 * field.Size[3] } : new[] { 1.0, 1.0, 1.0 };
            if (geometry.Mesh >= 0) return material.Uniform ? size : new[] { 1.0, 1.0, 1.0 };
            return material.Uniform ? new[] { 1.0, 1.0, 1.0 } : new[] { Invert(size[0]), Invert(size[1]), Invert(size[2]) };
        }

        private static double Invert(double value) { return value != 0.0 ? 1.0 / value : 1.0; }

        private static float[] Scale(float[] uv, double[] times)
        {
            float[] scaled = new float[uv.Length];
            for (int i = 0; i < uv.Length; i++) scaled[i] = (float)(uv[i] * times[i % 2]);
            return scaled;
        }

        private static float[] ProjectAlongZ(float[] positions, Geometry geometry, Material material)
        {
            double PerMetre(int axis) { return material.Repeat[axis] / (material.Uniform || !(geometry.Size[axis] > 0.0) ? 1.0 : geometry.Size[axis]); }

            double x = 0.5 * PerMetre(0);
            double y = -0.5 * PerMetre(1);
            float[] uv = new float[positions.Length / 3 * 2];
            for (int i = 0; 2 * i < uv.Length; i++)
            {
                uv[2 * i] = (float)(x * positions[3 * i] - 0.5);
                uv[2 * i + 1] = (float)(y * positions[3 * i + 1] - 0.5);
            }
            return uv;
        }

        /// <summary>Return the coordinates of corners, three for each triangle.</summary>
        private static float[] ComputeShape(MeshArrays flat, Geometry geometry)
        {
            float[] p = flat.Positions;
            double[] size = { Positive(geometry.Size[0]), Positive(geometry.Size[1]), Positive(geometry.Size[2]) };
            float[] uv = new float[2 * flat.VertexCount];
            double[] turns = new double[3];
            for (int t = 0; t < flat.VertexCount; t += 3)
            {
                ComputeTurns(p, t, size, turns);
                for (int k = 0; k < 3; k++)
                {
                    int i = t + k;
                    double z = p[3 * i + 2] / size[2];
                    double u = turns[k];
                    double v;
                    switch (geometry.Kind)
                    {
                        case GeometryKind.Sphere:
                        case GeometryKind.Ellipsoid:
                            v = 0.5 - Latitude(z);
                            break;
                        case GeometryKind.Cylinder:
                            bool isLid = Math.Abs(flat.Normals[3 * i + 2]) > 0.5;
                            v = isLid ? (p[3 * i + 1] / size[1] + 1.0) / 2.0 : 0.5 - z / 2.0;
                            if (isLid) u = (p[3 * i] / size[0] + 1.0) / 2.0;
                            break;
                        case GeometryKind.Capsule:
                            double end = FindCap(p, t, geometry.Size[2]);
                            v = end == 0.0 ? 0.5 - z / 2.0 : (end > 0.0 ? 1.0 : 0.0) - 2.0 * Latitude((p[3 * i + 2] - end * geometry.Size[2]) / geometry.Size[0]);
                            break;
                        default: // boxes and planes: by the axis of the normal
                            double nx = Math.Abs(flat.Normals[3 * i]);
                            double ny = Math.Abs(flat.Normals[3 * i + 1]);
                            double nz = Math.Abs(flat.Normals[3 * i + 2]);
                            int across = nx >= ny && nx >= nz ? 0 : ny >= nz ? 1 : 2;
                            int right = across == 0 ? 1 : 0;
                            int up = across == 2 ? 1 : 2;
                            u = (1.0 + p[3 * i + right] / size[right]) / 2.0;
                            v = (1.0 - p[3 * i + up] / size[up]) / 2.0;
                            break;
                    }
                    uv[2 * i] = (float)u;
                    uv[2 * i + 1] = (float)v;
                }
            }
            return uv;
        }

        private static double Positive(double size) { return size > 0.0 ? size : 1.0; }

        private static double Latitude(double height) { return Math.Asin(Math.Min(1.0, Math.Max(-1.0, height))) / Math.PI; }

        /// <summary>Return 1 for a triangle of the upper cap of a capsule, -1 of the lower one, 0 between.</summary>
        private static double FindCap(float[] p, int first, double half)
        {
            double middle = ((double)p[3 * first + 2] + p[3 * first + 5] + p[3 * first + 8]) / 3.0;
            return Math.Abs(middle) > half ? Math.Sign(middle) : 0.0;
        }

        /// <summary>Compute the angles around z of a triangle's corners, from x, in turns. Across the seam they go beyond 1; poles have the mean.</summary>
        private static void ComputeTurns(float[] p, int first, double[] size, double[] turns)
        {
            double high = 0.0;
            int defined = 0;
            for (int k = 0; k < 3; k++)
            {
                double x = p[3 * (first + k)] / size[0];
                double y = p[3 * (first + k) + 1] / size[1];
                double turn = Math.Atan2(y, x) / (2.0 * Math.PI);
                turns[k] = turn < 0.0 ? turn + 1.0 : turn;
                if (!(Math.Sqrt(x * x + y * y) > Pole)) continue;
                defined |= 1 << k;
                high = Math.Max(high, turns[k]);
            }
            double sum = 0.0;
            int count = 0;
            for (int k = 0; k < 3; k++)
            {
                if (high - turns[k] > 0.5) turns[k] += 1.0;
                if ((defined & (1 << k)) == 0) continue;
                sum += turns[k];
                count++;
            }
            for (int k = 0; k < 3; k++) if ((defined & (1 << k)) == 0) turns[k] = sum / Math.Max(count, 1);
        }
    }
}
