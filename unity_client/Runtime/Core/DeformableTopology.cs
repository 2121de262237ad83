// The mesh of a deformable stream, and the order in which its vertices are predicted. docs/deformables.md is normative.
using System;

namespace IrisSession.Core
{
    /// <summary>Topology of a deformable. Its tables are read-only.</summary>
    public sealed class DeformableTopology
    {
        private const int HeaderBytes = 24;
        private const int MaxVertices = 1 << 18;
        private const int MaxFaces = 1 << 20;
        private const int PlanTree = 1;

        public readonly int VertexCount;

        /// <summary>CRC-32 of its bytes: it is in every frame.</summary>
        public readonly uint Identity;

        /// <summary>Vertex at each place; null: place and vertex are the same.</summary>
        public readonly int[] Order;
        public readonly int Rows;
        public readonly int Cols;

        /// <summary>For a tree: the parents of every place; otherwise null.</summary>
        public readonly int[] ParentsA;
        public readonly int[] ParentsB;
        public readonly int[] ParentsC;

        /// <summary>Triangles of three vertices each, counter-clockwise from outside: flip them for Unity.</summary>
        public readonly int[] Faces;

        /// <summary>Lines of two vertices each.</summary>
        public readonly int[] Edges;

        /// <summary>Decode a topology.</summary>
        /// <exception cref="DecodeException">It must be refused. No more is allocated than its bytes hold.</exception>
        public DeformableTopology(byte[] bytes, int offset, int count)
        {
            if (count < HeaderBytes) throw new DecodeException("topology of " + count + " bytes, shorter than its header");
            int plan = bytes[offset + 1];
            int flags = BitConverter.ToUInt16(bytes, offset + 2);
            if (bytes[offset] != 1 || plan > PlanTree || flags > 1) throw new DecodeException("topology of format " + bytes[offset] + ", plan " + plan + ", flags " + flags);
            uint vertices = BitConverter.ToUInt32(bytes, offset + 4);
            uint rows = BitConverter.ToUInt32(bytes, offset + 8);
            uint cols = BitConverter.ToUInt32(bytes, offset + 12);
            uint faces = BitConverter.ToUInt32(bytes, offset + 16);
            uint edges = BitConverter.ToUInt32(bytes, offset + 20);
            if (vertices < 1 || vertices > MaxVertices || Math.Max(faces, edges) > MaxFaces)
            {
                throw new DecodeException("topology of " + vertices + " vertices, " + faces + " faces, " + edges + " edges");
            }
            bool isTree = plan == PlanTree;
            if (isTree ? rows != 0 || cols != 0 : (ulong)rows * cols != vertices) throw new DecodeException("topology: " + rows + " rows of " + cols + " for " + vertices + " vertices");
            long words = (flags + (isTree ? 3L : 0L)) * vertices + 3L * faces + 2L * edges;
            if (count != HeaderBytes + 4 * words) throw new DecodeException("topology of " + count + " bytes: its header asks for another number");
            VertexCount = (int)vertices;
            Rows = (int)rows;
            Cols = (int)cols;
            int at = offset + HeaderBytes;
            if (flags == 1)
            {
                Order = ReadTable(bytes, ref at, VertexCount);
                CheckOrder(Order);
            }
            if (isTree)
            {
                ParentsA = ReadParents(bytes, ref at);
                ParentsB = ReadParents(bytes, ref at);
                ParentsC = ReadParents(bytes, ref at);
            }
            Faces = ReadTable(bytes, ref at, 3 * (int)faces);
            Edges = ReadTable(bytes, ref at, 2 * (int)edges);
            Identity = Crc32.Compute(bytes, offset, count);
        }

        private int[] ReadTable(byte[] bytes, ref int at, int count)
        {
            int[] table = new int[count];
            for (int i = 0; i < count; i++, at += 4)
            {
                uint vertex = BitConverter.ToUInt32(bytes, at);
                if (vertex >= VertexCount) throw new DecodeException("topology names vertex " + vertex + " of " + VertexCount);
                table[i] = (int)vertex;
            }
            return table;
        }

        private int[] ReadParents(byte[] bytes, ref int at)
        {
            int[] table = ReadTable(bytes, ref at, VertexCount);
            for (int place = 0; place < table.Length; place++)
            {
                if (table[place] >= place && table[place] + place > 0) throw new DecodeException("topology: place " + place + " has a parent that is not before it");
            }
            return table;
        }

        private static void CheckOrder(int[] order)
        {
            bool[] seen = new bool[order.Length];
            foreach (int vertex in order)
            {
                if (seen[vertex]) throw new DecodeException("the order of a topology is not one of all vertices, each once");
                seen[vertex] = true;
            }
        }
    }

    /// <summary>The CRC-32 of zlib.</summary>
    internal static class Crc32
    {
        private static readonly uint[] Table = MakeTable();

        public static uint Compute(byte[] bytes, int offset, int count)
        {
            uint crc = uint.MaxValue;
            for (int i = offset; i < offset + count; i++) crc = (crc >> 8) ^ Table[(crc ^ bytes[i]) & 0xff];
            return ~crc;
        }

        private static uint[] MakeTable()
        {
            uint[] table = new uint[256];
            for (uint i = 0; i < 256; i++)
            {
                uint value = i;
                for (int bit = 0; bit < 8; bit++) value = (value & 1) == 0 ? value >> 1 : (value >> 1) ^ 0xedb88320;
                table[i] = value;
            }
            return table;
        }
    }
}
