// Interpolation of poses for a display, at a fixed delay behind session time. Pure.
//
// Positions are interpolated linearly, orientations by slerp. Nothing is extrapolated: without a newer frame the newest pose stays,
// and its age grows.
using System;

namespace IrisSession.Core
{
    /// <summary>Time of the poses that were written, session time. `IsStarved`: there is no newer frame.</summary>
    public readonly struct ShownPoses
    {
        public readonly long SessionTimeNs;
        public readonly long AgeNs;
        public readonly bool IsStarved;

        public ShownPoses(long sessionTimeNs, long ageNs, bool isStarved)
        {
            SessionTimeNs = sessionTimeNs;
            AgeNs = ageNs;
            IsStarved = isStarved;
        }
    }

    /// <summary>The last frames of poses, between which <see cref="TryGetPoses"/> interpolates. Allocates nothing once it is full.</summary>
    public sealed class PoseBuffer
    {
        /// <summary>A world whose newest state is older than this is shown as stale [ns].</summary>
        public const long StaleNs = 300_000_000;

        /// <summary>Time by which the shown poses are behind session time [ns]. Two frame periods hide one lost frame.</summary>
        public readonly long DelayNs;
        private readonly double[][] poses;
        private readonly long[] times;
        private int begin;
        private int count;
        private int length;
        private long shownNs;

        public PoseBuffer(long delayNs = 33_000_000, int capacity = 16)
        {
            DelayNs = delayNs;
            poses = new double[capacity][];
            times = new long[capacity];
        }

        /// <summary>Frames that were dropped because they came out of order, or of another size.</summary>
        public long Late { get; private set; }

        /// <summary>Calls of <see cref="TryGetPoses"/> that found no frame new enough.</summary>
        public long Starvations { get; private set; }

        /// <summary>Session time of the newest frame [ns]; `long.MinValue` without any.</summary>
        public long NewestNs { get { return count == 0 ? long.MinValue : times[At(count - 1)]; } }

        /// <summary>Remove all frames: after a jump of the scene (new `scene_epoch`) nothing may be interpolated across it.</summary>
        public void Clear()
        {
            count = 0;
            shownNs = 0;
        }

        /// <summary>Return whether the newest state is too old to act on: draw the world so that people see it.</summary>
        public bool IsStale(long nowNs)
        {
            return count == 0 || nowNs - NewestNs > StaleNs;
        }

        /// <summary>Copy a frame into the buffer.</summary>
        /// <param name="sessionTimeNs">Session time of the frame [ns].</param>
        /// <param name="frame">Rows `x y z qw qx qy qz`, world frame.</param>
        public void Add(long sessionTimeNs, double[] frame)
        {
            if (count > 0 && (sessionTimeNs < NewestNs || frame.Length != length))
            {
                Late++;
                return;
            }
            if (count == 0 || sessionTimeNs > NewestNs)
            {
                if (count == times.Length) begin = At(1);
                else count++;
            }
            int at = At(count - 1);
            length = frame.Length;
            if (poses[at] == null || poses[at].Length != length) poses[at] = new double[length];
            times[at] = sessionTimeNs;
            Array.Copy(frame, poses[at], length);
        }

        /// <summary>Write the poses at `nowNs - DelayNs`, or the nearest frame; the shown time never goes back.</summary>
        /// <param name="nowNs">Present session time [ns].</param>
        /// <param name="target">Rows for as many bodies as the frames have.</param>
        /// <param name="shown">Time and age of what was written.</param>
        /// <returns>False before the first frame, or when `target` has another size.</returns>
        public bool TryGetPoses(long nowNs, double[] target, out ShownPoses shown)
        {
            shown = default;
            if (count == 0 || target.Length != length) return false;
            long wanted = Math.Max(nowNs - DelayNs, shownNs);
            int after = count - 1;
            if (wanted >= NewestNs)
            {
                bool isStarved = wanted > NewestNs;
                if (isStarved) Starvations++;
                return Show(after, nowNs, isStarved, target, out shown);
            }
            while (after > 0 && times[At(after - 1)] > wanted) after--;
            if (after == 0) return Show(0, nowNs, false, target, out shown);
            int a = At(after - 1);
            int b = At(after);
            double fraction = (double)(wanted - times[a]) / (times[b] - times[a]);
            Interpolate(poses[a], poses[b], fraction, target);
            shownNs = wanted;
            shown = new ShownPoses(wanted, nowNs - wanted, false);
            return true;
        }

        /// <summary>Write rows between `a` (fraction 0) and `b` (1): linear positions, slerp along the shorter arc.</summary>
        public static void Interpolate(double[] a, double[] b, double fraction, double[] target)
        {
            for (int at = 0; at + 7 <= a.Length; at += 7)
            {
                for (int k = at; k < at + 3; k++) target[k] = a[k] + fraction * (b[k] - a[k]);
                double dot = a[at + 3] * b[at + 3] + a[at + 4] * b[at + 4] + a[at + 5] * b[at + 5] + a[at + 6] * b[at + 6];
                double sign = dot < 0.0 ? -1.0 : 1.0;
                double angle = Math.Acos(Math.Min(sign * dot, 1.0));
                double sine = Math.Sin(angle);
                double wa = 1.0 - fraction;
                double wb = fraction;
                if (!(sine < 1e-6)) // below a microradian slerp and lerp agree to rounding
                {
                    wa = Math.Sin((1.0 - fraction) * angle) / sine;
                    wb = Math.Sin(fraction * angle) / sine;
                }
                double w = wa * a[at + 3] + sign * wb * b[at + 3];
                double x = wa * a[at + 4] + sign * wb * b[at + 4];
                double y = wa * a[at + 5] + sign * wb * b[at + 5];
                double z = wa * a[at + 6] + sign * wb * b[at + 6];
                double norm = Math.Max(Math.Sqrt(w * w + x * x + y * y + z * z), 1e-12);
                target[at + 3] = w / norm;
                target[at + 4] = x / norm;
                target[at + 5] = y / norm;
                target[at + 6] = z / norm;
            }
        }

        private int At(int index)
        {
            return (begin + index) % times.Length;
        }

        private bool Show(int index, long nowNs, bool isStarved, double[] target, out ShownPoses shown)
        {
            int at = At(index);
            shownNs = times[at];
            Array.Copy(poses[at], target, length);
            shown = new ShownPoses(shownNs, nowNs - shownNs, isStarved);
            return true;
        }
    }
}
