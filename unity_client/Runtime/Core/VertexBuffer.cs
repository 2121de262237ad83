// Interpolation of vertices for a display, at the delay of the poses: what hangs together is shown at one time. Pure.
using System;

namespace IrisSession.Core
{
    /// <summary>The last frames of one deformable, between which <see cref="TryGetVertices"/> interpolates linearly.</summary>
    public sealed class VertexBuffer
    {
        private readonly float[][] frames;
        private readonly long[] times;
        private int begin;
        private int count;
        private int length;
        private long shownNs;

        public VertexBuffer(int capacity = 8)
        {
            frames = new float[capacity][];
            times = new long[capacity];
        }

        /// <summary>Frames that were dropped because they came out of order, or of another size.</summary>
        public long Late { get; private set; }

        /// <summary>Session time of the newest frame [ns]; `long.MinValue` without any.</summary>
        public long NewestNs { get { return count == 0 ? long.MinValue : times[At(count - 1)]; } }

        /// <summary>Remove all frames: after a jump of the scene nothing may be interpolated across it.</summary>
        public void Clear()
        {
            count = 0;
            shownNs = 0;
        }

        /// <summary>Copy a frame into the buffer: `MediaHeader.CaptureNs` and the positions of its decoder.</summary>
        public void Add(long captureNs, float[] positions)
        {
            if (count > 0 && (captureNs < NewestNs || positions.Length != length))
            {
                Late++;
                return;
            }
            if (count == 0 || captureNs > NewestNs)
            {
                if (count == times.Length) begin = At(1);
                else count++;
            }
            int at = At(count - 1);
            length = positions.Length;
            if (frames[at] == null || frames[at].Length != length) frames[at] = new float[length];
            times[at] = captureNs;
            Array.Copy(positions, frames[at], length);
        }

        /// <summary>Write the vertices at session time `wantedNs`, or the nearest frame; the shown time never goes back.</summary>
        /// <returns>False before the first frame, or when `target` has another size.</returns>
        public bool TryGetVertices(long wantedNs, float[] target)
        {
            if (count == 0 || target.Length != length) return false;
            shownNs = Math.Max(wantedNs, shownNs);
            int after = count - 1;
            while (after > 0 && times[At(after - 1)] > shownNs) after--;
            float[] b = frames[At(after)];
            if (after == 0 || shownNs >= times[At(after)])
            {
                Array.Copy(b, target, length);
                return true;
            }
            float[] a = frames[At(after - 1)];
            long from = times[At(after - 1)];
            float fraction = (float)((double)(shownNs - from) / (times[At(after)] - from));
            for (int i = 0; i < length; i++) target[i] = a[i] + fraction * (b[i] - a[i]);
            return true;
        }

        private int At(int index)
        {
            return (begin + index) % times.Length;
        }
    }
}
