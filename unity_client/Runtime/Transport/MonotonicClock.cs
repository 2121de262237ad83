using System.Diagnostics;

namespace IrisSession.Transport
{
    /// <summary>The clock of all `nowNs`: monotonic, the same on all threads.</summary>
    public static class MonotonicClock
    {
        private static readonly double NsPerTick = 1e9 / Stopwatch.Frequency;

        public static long NowNs { get { return (long)(Stopwatch.GetTimestamp() * NsPerTick); } }
    }
}
