// Meshes of the engine: the bytes of their vertices as the graphics card gets them, and what they mean.
using System;
using System.Runtime.InteropServices;
using Standins;
using UnityEngine.Rendering;

namespace UnityEngine.Rendering
{
    public enum IndexFormat
    {
        UInt16 = 0,
        UInt32 = 1,
    }

    [Flags]
    public enum MeshUpdateFlags
    {
        Default = 0,
        DontValidateIndices = 1,
        DontResetBoneBounds = 2,
        DontNotifyMeshUsers = 4,
        DontRecalculateBounds = 8,
    }

    public enum VertexAttribute
    {
        Position = 0,
        Normal = 1,
        Color = 3,
        TexCoord0 = 4,
        TexCoord1 = 5,
    }

    public enum VertexAttributeFormat
    {
        Float32 = 0,
        UNorm8 = 2,
    }

    public struct VertexAttributeDescriptor
    {
        public VertexAttributeDescriptor(VertexAttribute attribute = VertexAttribute.Position, VertexAttributeFormat format = VertexAttributeFormat.Float32, int dimension = 3, int stream = 0)
        {
            this.attribute = attribute;
            this.format = format;
            this.dimension = dimension;
            this.stream = stream;
        }

        public VertexAttribute attribute { get; set; }

        public VertexAttributeFormat format { get; set; }

        public int dimension { get; set; }

        public int stream { get; set; }

        internal int Bytes { get { return dimension * (format == VertexAttributeFormat.UNorm8 ? 1 : 4); } }
    }

    public struct SubMeshDescriptor
    {
        public SubMeshDescriptor(int indexStart, int indexCount, MeshTopology topology = MeshTopology.Triangles)
        {
            this.indexStart = indexStart;
            this.indexCount = indexCount;
            this.topology = topology;
        }

        public MeshTopology topology { get; set; }

        public int indexStart { get; set; }

        public int indexCount { get; set; }
    }

    public enum ShadowCastingMode
    {
        Off = 0,
        On = 1,
    }
}

namespace UnityEngine
{
    public enum MeshTopology
    {
        Triangles = 0,
        Lines = 3,
        Points = 5,
    }

    public sealed class Mesh : Object
    {
        private const int MaxStreams = 4; // of the engine
        private readonly byte[][] streams = new byte[MaxStreams][];
        private readonly int[] strides = new int[MaxStreams];
        private VertexAttributeDescriptor[] layout = new VertexAttributeDescriptor[0];
        private byte[] indices = new byte[0];
        private int count;
        private IndexFormat kind;
        private SubMeshDescriptor subMesh;

        public Mesh()
        {
            Engine.CheckThread();
            Live++;
        }

        /// <summary>Meshes that were made and not destroyed: the engine never does that by itself.</summary>
        internal static int Live { get; private set; }

        internal override void Release()
        {
            if (!IsDestroyed) Live--;
            base.Release();
        }

        public IndexFormat indexFormat { get { return kind; } set { kind = value; } }

        public int vertexCount { get { return count; } }

        public Bounds bounds { get; set; }

        /// <summary>Uploads since the mesh was made.</summary>
        internal int Uploads { get; private set; }

        internal bool IsDynamic { get; private set; }

        public Vector3[] vertices { get { return ReadVectors(VertexAttribute.Position); } }

        public Vector3[] normals { get { return ReadVectors(VertexAttribute.Normal); } }

        public Color32[] colors32
        {
            get
            {
                float[] values = ReadAll(VertexAttribute.Color, 4);
                Color32[] colors = new Color32[values.Length / 4];
                for (int i = 0; i < colors.Length; i++)
                {
                    colors[i] = new Color32(ToByte(values[4 * i]), ToByte(values[4 * i + 1]), ToByte(values[4 * i + 2]), ToByte(values[4 * i + 3]));
                }
                return colors;
            }
        }

        public Vector2[] uv
        {
            get
            {
                float[] values = ReadAll(VertexAttribute.TexCoord0, 2);
                Vector2[] places = new Vector2[values.Length / 2];
                for (int i = 0; i < places.Length; i++) places[i] = new Vector2(values[2 * i], values[2 * i + 1]);
                return places;
            }
        }

        public int[] triangles
        {
            get
            {
                if (subMesh.topology != MeshTopology.Triangles) return new int[0];
                int[] corners = new int[subMesh.indexCount];
                for (int i = 0; i < corners.Length; i++) corners[i] = ReadIndex(subMesh.indexStart + i);
                return corners;
            }
        }

        public void MarkDynamic() { IsDynamic = true; }

        public void SetVertexBufferParams(int vertexCount, params VertexAttributeDescriptor[] attributes)
        {
            Engine.CheckThread();
            layout = (VertexAttributeDescriptor[])attributes.Clone();
            count = vertexCount;
            Array.Clear(strides, 0, strides.Length);
            foreach (VertexAttributeDescriptor one in layout)
            {
                if (one.Bytes % 4 != 0) throw new ArgumentException("attributes have multiples of four bytes");
                strides[one.stream] += one.Bytes;
            }
            for (int i = 0; i < MaxStreams; i++) streams[i] = new byte[strides[i] * vertexCount];
        }

        public void SetVertexBufferData<T>(T[] data, int dataStart, int meshBufferStart, int count, int stream = 0, MeshUpdateFlags flags = MeshUpdateFlags.Default) where T : struct
        {
            Engine.CheckThread();
            Uploads++;
            Copy(data, dataStart, streams[stream], meshBufferStart, count);
        }

        public void SetIndexBufferParams(int indexCount, IndexFormat format)
        {
            Engine.CheckThread();
            kind = format;
            indices = new byte[indexCount * (format == IndexFormat.UInt16 ? 2 : 4)];
        }

        public void SetIndexBufferData<T>(T[] data, int dataStart, int meshBufferStart, int count, MeshUpdateFlags flags = MeshUpdateFlags.Default) where T : struct
        {
            Engine.CheckThread();
            if (Marshal.SizeOf(typeof(T)) != (kind == IndexFormat.UInt16 ? 2 : 4)) throw new ArgumentException("indices of another size");
            Copy(data, dataStart, indices, meshBufferStart, count);
        }

        public void SetSubMesh(int index, SubMeshDescriptor desc, MeshUpdateFlags flags = MeshUpdateFlags.Default)
        {
            Engine.CheckThread();
            if (index != 0) throw new NotSupportedException("the layer has one part a mesh");
            for (int i = 0; (flags & MeshUpdateFlags.DontValidateIndices) == 0 && i < desc.indexCount; i++)
            {
                if (ReadIndex(desc.indexStart + i) >= count) throw new ArgumentException("index " + i + " is beyond the vertices");
            }
            subMesh = desc;
        }

        /// <summary>The first `size` values of one attribute of each vertex; empty when vertices have none.</summary>
        internal float[] ReadAll(VertexAttribute attribute, int size)
        {
            int[] offsets = new int[MaxStreams];
            foreach (VertexAttributeDescriptor one in layout)
            {
                if (one.attribute != attribute)
                {
                    offsets[one.stream] += one.Bytes;
                    continue;
                }
                float[] values = new float[size * count];
                bool isByte = one.format == VertexAttributeFormat.UNorm8;
                for (int i = 0; i < values.Length; i++)
                {
                    int at = i / size * strides[one.stream] + offsets[one.stream];
                    values[i] = isByte ? streams[one.stream][at + i % size] / 255f : BitConverter.ToSingle(streams[one.stream], at + 4 * (i % size));
                }
                return values;
            }
            return new float[0];
        }

        private Vector3[] ReadVectors(VertexAttribute attribute)
        {
            float[] values = ReadAll(attribute, 3);
            Vector3[] vectors = new Vector3[values.Length / 3];
            for (int i = 0; i < vectors.Length; i++) vectors[i] = new Vector3(values[3 * i], values[3 * i + 1], values[3 * i + 2]);
            return vectors;
        }

        private static byte ToByte(float value) { return (byte)Math.Round(255f * value); }

        private int ReadIndex(int at)
        {
            return kind == IndexFormat.UInt16 ? BitConverter.ToUInt16(indices, 2 * at) : BitConverter.ToInt32(indices, 4 * at);
        }

        /// <summary>Copy elements; both starts count in elements.</summary>
        private static void Copy<T>(T[] source, int from, byte[] target, int to, int count) where T : struct
        {
            int size = Marshal.SizeOf(typeof(T));
            if (from < 0 || count < 0 || from + count > source.Length) throw new ArgumentException("beyond the data");
            if (to < 0 || (to + count) * size > target.Length) throw new ArgumentException("beyond the buffer of the mesh");
            MemoryMarshal.AsBytes(new ReadOnlySpan<T>(source, from, count)).CopyTo(new Span<byte>(target, to * size, count * size));
        }
    }

    public sealed class MeshFilter : Component
    {
        public Mesh sharedMesh { get; set; }
    }
}
