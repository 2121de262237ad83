// Meshes on the graphics card: one stream of vertices for each attribute, so that arrays of the core go there as they are.
using IrisSession.Core;
using UnityEngine;
using UnityEngine.Rendering;

namespace IrisSession.Unity
{
    /// <summary>Makes meshes and fills them again.</summary>
    public static class MeshUpload
    {
        private const int PositionStream = 0;
        private const int NormalStream = 1;
        private const int ColorStream = 2;
        private const int UvStream = 3;

        /// <summary>The core made the indices, and a mesh is drawn without physics.</summary>
        private const MeshUpdateFlags Unchecked = MeshUpdateFlags.DontValidateIndices | MeshUpdateFlags.DontRecalculateBounds | MeshUpdateFlags.DontResetBoneBounds;

        /// <summary>Return the mesh of a part.</summary>
        public static Mesh Make(PartMesh part, string name)
        {
            int count = part.Positions.Length / 3;
            float[] uv = part.CubeDirections ?? part.Uv;
            Mesh mesh = Begin(name, count, part.Indices, part.Colors, uv, part.CubeDirections != null ? 3 : 2);
            mesh.SetVertexBufferData(part.Positions, 0, 0, part.Positions.Length, PositionStream, Unchecked);
            mesh.SetVertexBufferData(part.Normals, 0, 0, part.Normals.Length, NormalStream, Unchecked);
            mesh.bounds = Measure(part.Positions);
            return mesh;
        }

        /// <summary>Return a mesh whose points change: <see cref="Update"/> fills it.</summary>
        public static Mesh MakeDynamic(DeformableSurface surface, string name)
        {
            Mesh mesh = Begin(name, surface.Positions.Length / 3, surface.Indices, null, surface.Uv, 2);
            mesh.MarkDynamic();
            return mesh;
        }

        /// <summary>Write points and normals in place. Allocates nothing.</summary>
        public static void Update(Mesh mesh, DeformableSurface surface)
        {
            mesh.SetVertexBufferData(surface.Positions, 0, 0, surface.Positions.Length, PositionStream, Unchecked);
            mesh.SetVertexBufferData(surface.Normals, 0, 0, surface.Normals.Length, NormalStream, Unchecked);
            mesh.bounds = UnityValues.ToBounds(surface.Low, surface.High);
        }

        /// <summary>Make the buffers. Every mesh has colours: what shaders read where there are none is not the same everywhere.</summary>
        private static Mesh Begin(string name, int count, int[] indices, byte[] colors, float[] uv, int uvSize)
        {
            Mesh mesh = new Mesh();
            mesh.name = name;
            VertexAttributeDescriptor position = new VertexAttributeDescriptor(VertexAttribute.Position, VertexAttributeFormat.Float32, 3, PositionStream);
            VertexAttributeDescriptor normal = new VertexAttributeDescriptor(VertexAttribute.Normal, VertexAttributeFormat.Float32, 3, NormalStream);
            VertexAttributeDescriptor color = new VertexAttributeDescriptor(VertexAttribute.Color, VertexAttributeFormat.UNorm8, 4, ColorStream);
            if (uv == null) mesh.SetVertexBufferParams(count, position, normal, color);
            else mesh.SetVertexBufferParams(count, position, normal, color, new VertexAttributeDescriptor(VertexAttribute.TexCoord0, VertexAttributeFormat.Float32, uvSize, UvStream));
            if (colors == null)
            {
                colors = new byte[4 * count];
                for (int i = 0; i < colors.Length; i++) colors[i] = 255;
            }
            mesh.SetVertexBufferData(colors, 0, 0, colors.Length, ColorStream, Unchecked);
            if (uv != null) mesh.SetVertexBufferData(uv, 0, 0, uv.Length, UvStream, Unchecked);
            mesh.SetIndexBufferParams(indices.Length, IndexFormat.UInt32);
            mesh.SetIndexBufferData(indices, 0, 0, indices.Length, Unchecked);
            mesh.SetSubMesh(0, new SubMeshDescriptor(0, indices.Length, MeshTopology.Triangles), Unchecked);
            return mesh;
        }

        private static Bounds Measure(float[] positions)
        {
            if (positions.Length == 0) return default;
            Vector3 low = new Vector3(positions[0], positions[1], positions[2]), high = low;
            for (int i = 3; i + 2 < positions.Length; i += 3)
            {
                float x = positions[i], y = positions[i + 1], z = positions[i + 2];
                low = new Vector3(x < low.x ? x : low.x, y < low.y ? y : low.y, z < low.z ? z : low.z);
                high = new Vector3(x > high.x ? x : high.x, y > high.y ? y : high.y, z > high.z ? z : high.z);
            }
            return new Bounds(0.5f * (low + high), high - low);
        }
    }
}
