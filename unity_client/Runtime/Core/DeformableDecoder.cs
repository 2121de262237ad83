// Deformable streams: frames to vertices. docs/deformables.md is normative.
using System;

namespace IrisSession.Core
{
    /// <summary>Decodes the frames of one deformable. Keeps its buffers, so that decoding allocates nothing.</summary>
    public sealed class DeformableDecoder
    {
        private const int HeaderBytes = 32;
        private const int EscapeBytes = 16;
        private const int MaxPlanes = 4;

        // Exponents of the lattice for bounds from 10 um to 4 m.
        private const int MinExponent = -17;
        private const int MaxExponent = 2;

        public readonly DeformableTopology Topology;

        /// <summary>Vertices, three numbers each [m], world frame. The next frame overwrites them.</summary>
        public readonly float[] Positions;
        private readonly Inflater inflater;
        private readonly int[] nodes;
        private byte[] planeBuffer = new byte[0];

        /// <param name="topology">That of the present scene.</param>
        /// <param name="inflater">May be shared by decoders of one thread.</param>
        public DeformableDecoder(DeformableTopology topology, Inflater inflater)
        {
            Topology = topology;
            this.inflater = inflater;
            Positions = new float[3 * topology.VertexCount];
            nodes = new int[topology.VertexCount];
        }

        /// <summary>Bound of the error of every vertex of the newest frame [m], 0 before the first.</summary>
        public float BoundM { get; private set; }

        /// <summary>Decode a frame to <see cref="Positions"/>.</summary>
        /// <exception cref="DecodeException">It must be refused; the positions have not changed.</exception>
        public void Decode(byte[] frame, int offset, int count)
        {
            int vertexCount = Topology.VertexCount;
            if (count < HeaderBytes) throw new DecodeException("deformable frame of " + count + " bytes, shorter than its header");
            int format = frame[offset];
            int flags = frame[offset + 1];
            int planes = frame[offset + 2];
            int exponent = (sbyte)frame[offset + 3];
            float boundM = BitConverter.ToSingle(frame, offset + 4);
            if (format != 2 || flags > 1 || planes > MaxPlanes) throw new DecodeException("deformable frame of format " + format + ", flags " + flags + ", " + planes + " planes");
            if (exponent < MinExponent || exponent > MaxExponent || !(boundM > 0f) || float.IsInfinity(boundM))
            {
                throw new DecodeException("deformable frame with a lattice of 2^" + exponent + " m and a bound of " + boundM + " m");
            }
            if (BitConverter.ToUInt32(frame, offset + 8) != vertexCount || BitConverter.ToUInt32(frame, offset + 12) != Topology.Identity)
            {
                throw new DecodeException("deformable frame of another mesh: use the topology of the present scene");
            }
            uint escaped = BitConverter.ToUInt32(frame, offset + 16);
            long atPlanes = HeaderBytes + EscapeBytes * (long)escaped;
            if (escaped > vertexCount || count < atPlanes) throw new DecodeException("deformable frame: " + escaped + " escapes do not fit " + count + " bytes");
            CheckEscapes(frame, offset + HeaderBytes, (int)escaped);
            byte[] coded = ReadPlanes(frame, offset + (int)atPlanes, count - (int)atPlanes, flags, planes, out int from);
            float step = (float)Math.Pow(2.0, exponent);
            for (int axis = 0; axis < 3; axis++)
            {
                ReadResiduals(coded, from, planes, axis);
                UndoPrediction();
                WriteAxis(axis, BitConverter.ToInt32(frame, offset + 20 + 4 * axis), step);
            }
            int at = offset + HeaderBytes;
            for (int i = 0; i < escaped; i++, at += EscapeBytes) Buffer.BlockCopy(frame, at + 4, Positions, 12 * BitConverter.ToInt32(frame, at), 12);
            BoundM = boundM;
        }

        private void CheckEscapes(byte[] frame, int at, int escaped)
        {
            long before = -1;
            for (int i = 0; i < escaped; i++, at += EscapeBytes)
            {
                uint vertex = BitConverter.ToUInt32(frame, at);
                if (vertex <= before || vertex >= Topology.VertexCount) throw new DecodeException("deformable frame: escaped vertices are not ascending and in range");
                before = vertex;
            }
        }

        /// <summary>Return the planes, and where they begin.</summary>
        private byte[] ReadPlanes(byte[] frame, int at, int count, int flags, int planes, out int from)
        {
            int size = 3 * Topology.VertexCount * planes;
            from = at;
            if (flags == 0)
            {
                if (count != size) throw new DecodeException("deformable frame: planes of " + count + " bytes, its header asks for " + size);
                return frame;
            }
            Inflater.CheckSize(count, size);
            if (planeBuffer.Length < size) planeBuffer = new byte[size];
            inflater.Inflate(frame, at, count, planeBuffer, size);
            from = 0;
            return planeBuffer;
        }

        private void ReadResiduals(byte[] coded, int from, int planes, int axis)
        {
            int count = nodes.Length;
            Array.Clear(nodes, 0, count);
            for (int plane = 0; plane < planes; plane++)
            {
                int at = from + (3 * plane + axis) * count;
                int shift = 8 * plane;
                for (int i = 0; i < count; i++) nodes[i] |= coded[at + i] << shift;
            }
            for (int i = 0; i < count; i++) nodes[i] = (int)((uint)nodes[i] >> 1) ^ -(nodes[i] & 1);
        }

        /// <summary>Turn residuals into nodes, in place. Sums wrap.</summary>
        private void UndoPrediction()
        {
            unchecked
            {
                if (Topology.ParentsA != null)
                {
                    int[] a = Topology.ParentsA, b = Topology.ParentsB, c = Topology.ParentsC;
                    for (int i = 1; i < nodes.Length; i++) nodes[i] += nodes[a[i]] + nodes[b[i]] - nodes[c[i]];
                    return;
                }
                int cols = Topology.Cols;
                for (int i = cols; i < nodes.Length; i++) nodes[i] += nodes[i - cols];
                for (int row = 0; row < nodes.Length; row += cols)
                {
                    for (int i = row + 1; i < row + cols; i++) nodes[i] += nodes[i - 1];
                }
            }
        }

        private void WriteAxis(int axis, int origin, float step)
        {
            int[] order = Topology.Order;
            for (int i = 0; i < nodes.Length; i++)
            {
                int vertex = order == null ? i : order[i];
                Positions[3 * vertex + axis] = (float)unchecked(nodes[i] + origin) * step; // exact: the step is a power of two
            }
        }
    }
}
