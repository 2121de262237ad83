// The mesh of a ScenePart, in Unity's axes: its shapes, placed and joined.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Where meshes and height fields come from.</summary>
    public interface ISceneAssets
    {
        /// <summary>Return the bytes of an asset whose hash was checked; null while it is not here.</summary>
        byte[] Find(string address);
    }

    /// <summary>Vertices and triangles as Unity's `Mesh` takes them: left-handed, Y up, clockwise from outside.</summary>
    public sealed class PartMesh
    {
        /// <summary>Three floats for each vertex.</summary>
        public readonly float[] Positions;
        public readonly float[] Normals;

        /// <summary>Two floats for each vertex, to the right and up; null for none.</summary>
        public readonly float[] Uv;

        /// <summary>Direction by which a cube texture is sampled, in the axes of the scene, three floats; null for none.</summary>
        public readonly float[] CubeDirections;

        /// <summary>Red, green, blue, alpha for each vertex; null when no shape has colours.</summary>
        public readonly byte[] Colors;
        public readonly int[] Indices;

        private PartMesh(int vertices, int indices, SceneLook look, bool hasColors)
        {
            Positions = new float[3 * vertices];
            Normals = new float[3 * vertices];
            Uv = look.Mapping == TextureMapping.Map ? new float[2 * vertices] : null;
            CubeDirections = look.Mapping == TextureMapping.Cube ? new float[3 * vertices] : null;
            Colors = hasColors ? new byte[4 * vertices] : null;
            Indices = new int[indices];
        }

        /// <summary>Build the mesh of a part.</summary>
        /// <param name="coarse">Take the coarsest levels, which come first.</param>
        /// <returns>The mesh, null while an asset is missing.</returns>
        /// <exception cref="DecodeException">An asset is not what the specification says.</exception>
        public static PartMesh Build(ScenePlan plan, ScenePart part, ISceneAssets assets, ArrayDecoder decoder, bool coarse = false)
        {
            MeshArrays[] meshes = new MeshArrays[part.Shapes.Length];
            float[][] cubes = new float[part.Shapes.Length][];
            long vertices = 0;
            long indices = 0;
            bool hasColors = false;
            for (int i = 0; i < meshes.Length; i++)
            {
                Geometry geometry = part.Shapes[i].Geometry;
                MeshArrays mesh = Load(plan, geometry, assets, decoder, coarse);
                if (mesh == null) return null;
                if (part.Look.Mapping != TextureMapping.None)
                {
                    Material material = plan.Spec.Materials[part.Look.Material];
                    if (part.Look.Mapping == TextureMapping.Map) mesh = TextureCoordinates.Add(mesh, geometry, material);
                    else cubes[i] = TextureCoordinates.ComputeCubeDirections(ref mesh, geometry, material, geometry.Mesh < 0 && geometry.Hfield >= 0 ? plan.Spec.Hfields[geometry.Hfield] : null);
                }
                meshes[i] = mesh;
                vertices += mesh.VertexCount;
                indices += mesh.Indices.Length;
                hasColors |= mesh.Colors != null;
            }
            if (3 * vertices > int.MaxValue / 8 || indices > int.MaxValue / 8) throw new DecodeException("a part of " + vertices + " vertices");
            PartMesh built = new PartMesh((int)vertices, (int)indices, part.Look, hasColors);
            int at = 0;
            int from = 0;
            for (int i = 0; i < meshes.Length; i++)
            {
                built.Add(meshes[i], cubes[i], part.Shapes[i].T_part_shape, at, from);
                at += meshes[i].VertexCount;
                from += meshes[i].Indices.Length;
            }
            UnityAxes.PointsToUnity(built.Positions, built.Positions, at);
            UnityAxes.PointsToUnity(built.Normals, built.Normals, at);
            UnityAxes.FlipWinding(built.Indices);
            return built;
        }

        private static MeshArrays Load(ScenePlan plan, Geometry geometry, ISceneAssets assets, ArrayDecoder decoder, bool coarse)
        {
            if (geometry.Mesh < 0 && geometry.Hfield < 0) return MeshArrays.FromPrimitive(geometry);
            HeightField field = geometry.Mesh < 0 ? plan.Spec.Hfields[geometry.Hfield] : null;
            string address = field != null ? field.Address : plan.FindLevel(geometry).Address;
            if (coarse && field == null)
            {
                MeshLevel[] levels = plan.Spec.Meshes[geometry.Mesh].Levels;
                address = levels[levels.Length - 1].Address;
            }
            byte[] bytes = assets.Find(address);
            if (bytes == null) return null;
            ArrayAsset asset = decoder.Decode(bytes);
            if (field == null) return MeshArrays.FromAsset(asset);
            if (asset.Kind != ArrayKind.Grid) throw new DecodeException("an asset of another kind where a height field is needed");
            return MeshArrays.FromHeightField(field, asset.RequireFloats("elevation", ArrayAsset.Any, ArrayAsset.Any));
        }

        private void Add(MeshArrays mesh, float[] cube, RigidTransform pose, int at, int from)
        {
            for (int i = 0; i < mesh.VertexCount; i++)
            {
                Write(Positions, at + i, pose.TransformPoint(Read(mesh.Positions, i)));
                Write(Normals, at + i, pose.Rotation.Rotate(Read(mesh.Normals, i)));
                if (Uv != null)
                {
                    Uv[2 * (at + i)] = mesh.Uv[2 * i];
                    Uv[2 * (at + i) + 1] = 1.0f - mesh.Uv[2 * i + 1];
                }
                if (Colors == null) continue;
                for (int k = 0; k < 4; k++) Colors[4 * (at + i) + k] = mesh.Colors == null ? (byte)255 : mesh.Colors[4 * i + k];
            }
            if (cube != null) Array.Copy(cube, 0, CubeDirections, 3 * at, cube.Length);
            for (int i = 0; i < mesh.Indices.Length; i++) Indices[from + i] = at + mesh.Indices[i];
        }

        private static Double3 Read(float[] values, int index) { return new Double3(values[3 * index], values[3 * index + 1], values[3 * index + 2]); }

        private static void Write(float[] values, int index, Double3 value)
        {
            values[3 * index] = (float)value.X;
            values[3 * index + 1] = (float)value.Y;
            values[3 * index + 2] = (float)value.Z;
        }
    }
}
