// Where the head was: a runtime says some frames later when it saw a code.
using System;

namespace IrisSession.Core
{
    /// <summary>Poses of the head of the last seconds. Allocates nothing.</summary>
    public sealed class HeadHistory
    {
        /// <summary>Two seconds at 120 Hz.</summary>
        private const int Capacity = 256;

        private readonly long[] times = new long[Capacity];
        private readonly RigidTransform[] poses = new RigidTransform[Capacity];
        private int count;
        private int next;

        public bool IsEmpty { get { return count == 0; } }

        public void Add(long captureNs, RigidTransform T_tracking_head)
        {
            times[next] = captureNs;
            poses[next] = T_tracking_head;
            next = (next + 1) % Capacity;
            if (count < Capacity) count++;
        }

        /// <summary>Return the sample nearest in time, of two seconds; false without any. `captureNs`: its own time.</summary>
        public bool TryFind(long aboutNs, out long captureNs, out RigidTransform T_tracking_head)
        {
            int best = -1;
            for (int i = 0; i < count; i++)
            {
                if (best < 0 || Math.Abs(times[i] - aboutNs) < Math.Abs(times[best] - aboutNs)) best = i;
            }
            captureNs = best < 0 ? 0 : times[best];
            T_tracking_head = best < 0 ? RigidTransform.Identity : poses[best];
            return best >= 0;
        }

        public void Clear()
        {
            count = next = 0;
        }
    }
}
