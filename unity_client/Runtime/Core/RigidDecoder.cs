// Rigid-state stream: payloads to poses. docs/protocol.md, section 8 (bytes) and section 7 (completeness), is normative.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Poses of the bodies of a scene, kept up to date by frames and keyframes. Decoding allocates nothing.</summary>
    public sealed class RigidDecoder
    {
        private const int HeaderBytes = 20;
        private const int EscapeBytes = 58;
        private const int NarrowBytes = 12;
        private const int WideBytes = 18;
        private const uint PositionMask = (1u << Wire.RigidPositionBits) - 1;
        private const double Step = 1.0 / Wire.RigidRotationCentre;

        /// <summary>Squared length of rotation parameters that still is a rotation, with a little for rounding.</summary>
        private static readonly double MaxSquares = Math.Pow(1.0 + 0.5 * Math.Sqrt(3.0) / Wire.RigidRotationCentre, 2.0) + 1e-12;

        /// <summary>Rows `x y z qw qx qy qz`, world frame; NaN until first received. The next frame overwrites them.</summary>
        public readonly double[] Poses;

        // A payload, taken apart: its rows and the body of each.
        private readonly double[] rows;
        private readonly ushort[] bodies;

        /// <summary>Newest frame at which the pose of a body was known to be within the bound, -1 for none.</summary>
        private readonly long[] held;

        public RigidDecoder(int bodyCount)
        {
            if (bodyCount < 0 || bodyCount > ushort.MaxValue) throw new DecodeException("a scene of " + bodyCount + " bodies: at most 65535 are read");
            BodyCount = bodyCount;
            Poses = new double[7 * bodyCount];
            rows = new double[7 * bodyCount];
            bodies = new ushort[bodyCount];
            held = new long[bodyCount];
            for (int i = 0; i < Poses.Length; i++) Poses[i] = double.NaN;
            for (int i = 0; i < held.Length; i++) held[i] = -1;
        }

        public int BodyCount { get; }

        /// <summary>Number of the newest frame, 0 for none.</summary>
        public long StateSeq { get; private set; }

        /// <summary>The newest frame holds every body that was changed after this frame.</summary>
        public long BaseSeq { get; private set; }

        /// <summary>Frames that came after a newer one.</summary>
        public long StaleFrames { get; private set; }

        /// <summary>True if every body is within the bound at <see cref="StateSeq"/>.</summary>
        public bool IsComplete
        {
            get
            {
                if (StateSeq == 0) return false;
                for (int i = 0; i < held.Length; i++) if (held[i] < StateSeq) return false;
                return true;
            }
        }

        /// <summary>Apply one frame. Returns false when a snapshot is needed.</summary>
        /// <exception cref="DecodeException">The payload must be refused; nothing has changed.</exception>
        public bool Apply(long stateSeq, long baseSeq, byte[] payload, int offset, int count)
        {
            if (baseSeq < 0 || baseSeq > stateSeq) throw new DecodeException("rigid state: base_seq " + baseSeq + " and state_seq " + stateSeq);
            if (stateSeq <= StateSeq)
            {
                StaleFrames++;
                return IsComplete;
            }
            int found = Unpack(payload, offset, count);
            StateSeq = stateSeq;
            BaseSeq = baseSeq;
            for (int row = 0; row < found; row++)
            {
                int body = bodies[row];
                Array.Copy(rows, 7 * row, Poses, 7 * body, 7);
                held[body] = stateSeq;
            }
            CarryOver();
            return IsComplete;
        }

        /// <summary>Take the poses of a snapshot: the bytes of its bulk frame. Newer poses are kept. Returns true when complete.</summary>
        /// <exception cref="DecodeException">Its size is not that of the bodies; nothing has changed.</exception>
        public bool LoadKeyframe(long stateSeq, byte[] bulk, int offset, int count)
        {
            if (count != 56 * BodyCount) throw new DecodeException("keyframe of " + count + " bytes, expected " + 56 * BodyCount);
            for (int body = 0; body < BodyCount; body++)
            {
                if (held[body] >= stateSeq) continue;
                Buffer.BlockCopy(bulk, offset + 56 * body, Poses, 56 * body, 56);
                held[body] = stateSeq;
            }
            if (stateSeq > StateSeq) StateSeq = BaseSeq = stateSeq;
            CarryOver();
            return IsComplete;
        }

        /// <summary>Mark as current what was known at the base or later: what is not in the newest frame has not changed.</summary>
        private void CarryOver()
        {
            long least = Math.Max(BaseSeq, 1);
            for (int body = 0; body < held.Length; body++) if (held[body] >= least) held[body] = StateSeq;
        }

        /// <summary>Write rows and bodies of a payload to the buffers. Returns their number.</summary>
        private int Unpack(byte[] payload, int offset, int length)
        {
            if (length < HeaderBytes) throw new DecodeException("rigid state of " + length + " bytes, shorter than its header");
            int format = payload[offset];
            int layout = payload[offset + 1];
            int stated = BitConverter.ToUInt16(payload, offset + 2);
            int count = BitConverter.ToUInt16(payload, offset + 4);
            int escaped = BitConverter.ToUInt16(payload, offset + 6);
            if (format != Wire.RigidFormat || stated != BodyCount)
            {
                throw new DecodeException("rigid state of format " + format + " for " + stated + " bodies, expected format " + Wire.RigidFormat + " for " + BodyCount);
            }
            if (layout > 1 || count > BodyCount) throw new DecodeException("rigid state: layout " + layout + " of " + count + " bodies");
            int atMask = HeaderBytes + count * (layout == 0 ? NarrowBytes : WideBytes);
            int atEscapes = atMask + (count == BodyCount ? 0 : (BodyCount + 7) / 8);
            int end = atEscapes + escaped * EscapeBytes;
            if (length != end) throw new DecodeException("rigid state of " + length + " bytes, its header asks for " + end);
            if (count == BodyCount)
            {
                if (escaped > 0) throw new DecodeException("rigid state: escapes of bodies that are quantised");
                for (int i = 0; i < count; i++) bodies[i] = (ushort)i;
            }
            else
            {
                ReadMask(payload, offset + atMask, atEscapes - atMask, count);
                ReadEscapes(payload, offset + atMask, offset + atEscapes, count, escaped);
            }
            if (layout == 0) ReadNarrow(payload, offset, count);
            else ReadWide(payload, offset, count);
            return count + escaped;
        }

        /// <summary>Write the bodies of the mask to the buffer.</summary>
        private void ReadMask(byte[] payload, int at, int bytes, int count)
        {
            int found = 0;
            for (int i = 0; i < bytes; i++)
            {
                int mask = payload[at + i];
                for (int body = 8 * i; mask != 0; mask >>= 1, body++)
                {
                    if ((mask & 1) == 0) continue;
                    if (found == count || body >= BodyCount) throw new DecodeException("rigid state: the mask marks other than " + count + " of " + BodyCount + " bodies");
                    bodies[found++] = (ushort)body;
                }
            }
            if (found != count) throw new DecodeException("rigid state: the mask marks " + found + " bodies, expected " + count);
        }

        private void ReadEscapes(byte[] payload, int atMask, int at, int count, int escaped)
        {
            int before = -1;
            for (int i = 0; i < escaped; i++, at += EscapeBytes)
            {
                int body = BitConverter.ToUInt16(payload, at);
                if (body <= before || body >= BodyCount || (payload[atMask + (body >> 3)] & (1 << (body & 7))) != 0)
                {
                    throw new DecodeException("rigid state: escaped bodies are not ascending, in range and apart from the mask");
                }
                // So no more than there are bodies apart from the mask: the row is in the buffer.
                bodies[count + i] = (ushort)body;
                Buffer.BlockCopy(payload, at + 2, rows, 56 * (count + i), 56);
                before = body;
            }
        }

        private void ReadNarrow(byte[] payload, int offset, int count)
        {
            int at = offset + HeaderBytes;
            int ox = BitConverter.ToInt32(payload, offset + 8);
            int oy = BitConverter.ToInt32(payload, offset + 12);
            int oz = BitConverter.ToInt32(payload, offset + 16);
            for (int i = 0; i < count; i++, at += 4)
            {
                uint x = BitConverter.ToUInt32(payload, at);
                uint y = BitConverter.ToUInt32(payload, at + 4 * count);
                uint z = BitConverter.ToUInt32(payload, at + 8 * count);
                WritePosition(i, (double)(x & PositionMask) + ox, (double)(y & PositionMask) + oy, (double)(z & PositionMask) + oz);
                WriteRotation(i, (int)(x >> Wire.RigidPositionBits), (int)(y >> Wire.RigidPositionBits), (int)(z >> Wire.RigidPositionBits));
            }
        }

        private void ReadWide(byte[] payload, int offset, int count)
        {
            int at = offset + HeaderBytes;
            int atLevels = at + 12 * count;
            int ox = BitConverter.ToInt32(payload, offset + 8);
            int oy = BitConverter.ToInt32(payload, offset + 12);
            int oz = BitConverter.ToInt32(payload, offset + 16);
            for (int i = 0; i < count; i++, at += 4, atLevels += 2)
            {
                WritePosition(
                    i,
                    (double)BitConverter.ToUInt32(payload, at) + ox,
                    (double)BitConverter.ToUInt32(payload, at + 4 * count) + oy,
                    (double)BitConverter.ToUInt32(payload, at + 8 * count) + oz);
                WriteRotation(
                    i,
                    BitConverter.ToUInt16(payload, atLevels),
                    BitConverter.ToUInt16(payload, atLevels + 2 * count),
                    BitConverter.ToUInt16(payload, atLevels + 4 * count));
            }
        }

        private void WritePosition(int row, double x, double y, double z)
        {
            rows[7 * row] = x * Wire.RigidLatticeM;
            rows[7 * row + 1] = y * Wire.RigidLatticeM;
            rows[7 * row + 2] = z * Wire.RigidLatticeM;
        }

        private void WriteRotation(int row, int levelX, int levelY, int levelZ)
        {
            double x = (levelX - Wire.RigidRotationCentre) * Step;
            double y = (levelY - Wire.RigidRotationCentre) * Step;
            double z = (levelZ - Wire.RigidRotationCentre) * Step;
            double squares = x * x + y * y + z * z;
            if (squares > MaxSquares) throw new DecodeException("rigid state: rotation levels do not encode a rotation");
            double scale = 2.0 / (1.0 + squares);
            rows[7 * row + 3] = scale - 1.0;
            rows[7 * row + 4] = x * scale;
            rows[7 * row + 5] = y * scale;
            rows[7 * row + 6] = z * scale;
        }
    }
}
