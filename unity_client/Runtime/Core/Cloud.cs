// Point cloud frames: a header and points that a graphics card takes as they are. docs/clouds.md is normative.
using System;

namespace IrisSession.Core
{
    /// <summary>A cloud. Point i is at (origin + node) * step [m], world frame; every beginning is a fair sample of the whole.</summary>
    public sealed class Cloud
    {
        private const int HeaderBytes = 32;
        private const int PointBytes = 8;
        private const int MaxPoints = 1 << 21;
        private const int MinExponent = -14;
        private const int MaxExponent = -4;
        private const int MaxOrigin = 1 << 23;
        private const float MaxVoxelM = 10f;

        /// <summary>
        /// Four numbers a point: x, y and z of its node, and its colour: 5 bits of red (the highest), 6 of green, 5 of blue.
        /// Longer than needed where an earlier frame had more points.
        /// </summary>
        public ushort[] Points { get; private set; } = new ushort[0];

        /// <summary>Number of points.</summary>
        public int Count { get; private set; }

        /// <summary>Lattice node of the lowest corner.</summary>
        public int OriginX { get; private set; }

        public int OriginY { get; private set; }

        public int OriginZ { get; private set; }

        /// <summary>Step of the lattice [m].</summary>
        public float StepM { get; private set; }

        /// <summary>Error that the source states, 95 % [m]; infinite where that is not known.</summary>
        public float ErrorM { get; private set; }

        /// <summary>Edge of the cell that a point stands for, 0 where it stands for itself [m].</summary>
        public float VoxelM { get; private set; }

        /// <summary>Decode a frame into this cloud. Allocates only when it has more points than any before.</summary>
        /// <exception cref="DecodeException">It must be refused; nothing has changed.</exception>
        public void Decode(byte[] frame, int offset, int count)
        {
            if (count < HeaderBytes) throw new DecodeException("cloud of " + count + " bytes, shorter than its header");
            int exponent = (sbyte)frame[offset + 2];
            if (frame[offset] != 1 || frame[offset + 1] != 0 || frame[offset + 3] != 0 || BitConverter.ToUInt32(frame, offset + 28) != 0)
            {
                throw new DecodeException("cloud of format " + frame[offset] + ", flags " + frame[offset + 1]);
            }
            uint points = BitConverter.ToUInt32(frame, offset + 4);
            int x = BitConverter.ToInt32(frame, offset + 8);
            int y = BitConverter.ToInt32(frame, offset + 12);
            int z = BitConverter.ToInt32(frame, offset + 16);
            if (exponent < MinExponent || exponent > MaxExponent || !IsNear(x) || !IsNear(y) || !IsNear(z))
            {
                throw new DecodeException("cloud with a lattice of 2^" + exponent + " m from node " + x + ", " + y + ", " + z);
            }
            float errorM = BitConverter.ToSingle(frame, offset + 20);
            float voxelM = BitConverter.ToSingle(frame, offset + 24);
            if (!(errorM > 0f) || !(voxelM >= 0f && voxelM <= MaxVoxelM)) throw new DecodeException("cloud with an error of " + errorM + " m and voxels of " + voxelM + " m");
            if (points > MaxPoints || count != HeaderBytes + PointBytes * points) throw new DecodeException(points + " points do not make a cloud of " + count + " bytes");
            if (Points.Length < 4 * points) Points = new ushort[4 * points];
            Buffer.BlockCopy(frame, offset + HeaderBytes, Points, 0, PointBytes * (int)points);
            Count = (int)points;
            OriginX = x;
            OriginY = y;
            OriginZ = z;
            StepM = (float)Math.Pow(2.0, exponent);
            ErrorM = errorM;
            VoxelM = voxelM;
        }

        /// <summary>Return the place of a point [m], world frame. Exact in float32.</summary>
        public Double3 GetPosition(int point)
        {
            int at = 4 * point;
            return new Double3((double)(OriginX + Points[at]) * StepM, (double)(OriginY + Points[at + 1]) * StepM, (double)(OriginZ + Points[at + 2]) * StepM);
        }

        private static bool IsNear(int node)
        {
            return node >= -MaxOrigin && node <= MaxOrigin;
        }
    }
}
