// Clock synchronisation against a simulated network: error within the stated bound, monotonic, slewed.
using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ClockSyncTests
    {
        private const long Second = 1_000_000_000;
        private const long Offset = 5 * Second; // session time - local time

        [Test]
        public void ErrorStaysWithinTheStatedBound()
        {
            Random random = new Random(41);
            for (int run = 0; run < 40; run++)
            {
                ClockSync clock = new ClockSync();
                double drift = 90e-6 * (2 * random.NextDouble() - 1);
                double delayMs = 0.05 + 40 * random.NextDouble();
                long offset = (long)(1e15 * (2 * random.NextDouble() - 1));
                long local = 0;
                long last = long.MinValue;
                for (int i = 0; i < 80; i++)
                {
                    long outNs = (long)(1e6 * delayMs * (1 - Math.Log(1 - random.NextDouble())));
                    long backNs = (long)(1e6 * delayMs * (1 - Math.Log(1 - random.NextDouble())));
                    local = Exchange(clock, local, outNs, backNs, offset + (long)(drift * local)) + (long)(Second * random.NextDouble());
                    foreach (long at in new[] { local, local + Second / 3 })
                    {
                        long error = Math.Abs(clock.SessionNs(at) - (at + offset + (long)(drift * at)));
                        Assert.LessOrEqual(error, clock.ErrorBoundNs(at) + 5);
                    }
                    Assert.LessOrEqual(last, clock.SessionNs(local));
                    last = clock.SessionNs(local);
                }
            }
        }

        [Test]
        public void StartOnABusyLinkDoesNotLeaveSamplesInTheFutureForSeconds()
        {
            ClockSync clock = new ClockSync();
            long local = 0;
            for (int i = 0; i < 8; i++) local = Exchange(clock, local, 40_000_000, 0);
            local = Exchange(clock, local, 0, 0);
            foreach ((long after, long ahead) in new[] { (0L, 20_000_000L), (Second / 10, 10_000_000L), (Second * 3 / 20, 5_000_000L), (Second / 4, 4_000_000L), (Second, 0L) })
            {
                Assert.AreEqual(ahead, clock.SessionNs(local + after) - (local + after + Offset), 10.0);
            }
        }

        [TestCase(10, 5, 5, 9)]
        [TestCase(0, 10, 5, 20)]
        [TestCase(0, 0, 30, 20)]
        [TestCase(0, long.MinValue, long.MaxValue, 20)]
        [TestCase(long.MinValue, 0, 0, long.MaxValue)]
        [TestCase(0, long.MaxValue, long.MaxValue, 1)]
        public void ImpossibleExchangesAreCountedAndIgnored(long t0, long t1, long t2, long t3)
        {
            ClockSync clock = new ClockSync();
            clock.ProcessPong(t0, t1, t2, t3);
            Assert.AreEqual(1, clock.Rejected);
            Assert.IsFalse(clock.IsSynced);
        }

        [Test]
        public void PingsStartAsABurstThenSlowDown()
        {
            ClockSync clock = new ClockSync();
            int early = 0, late = 0;
            for (long t = 0; t < 3 * Second; t += 1_000_000)
            {
                if (!clock.PollPing(t)) continue;
                if (t < Second / 4) early++;
                else late++;
            }
            Assert.AreEqual(8, early);
            Assert.IsTrue(late >= 4 && late <= 7);
            clock.Reset();
            Assert.IsTrue(clock.PollPing(0));
        }

        [Test]
        public void SuspendedMachineIsSynchronisedAfterFourExchanges()
        {
            ClockSync clock = new ClockSync();
            long local = 0;
            for (int i = 0; i < 16; i++) local = Exchange(clock, local, 300_000, 300_000) + Second / 2;
            long slept = 3600 * Second; // our clock stopped, the session's continued
            for (int i = 0; i < 4; i++)
            {
                Assert.Less(Math.Abs(clock.SessionNs(local) - local - Offset), 1_000_000); // a single outlier changes nothing
                local = Exchange(clock, local, 300_000, 300_000, Offset + slept);
                Assert.LessOrEqual(Math.Abs(clock.SessionNs(local) - (local + Offset + slept)), clock.ErrorBoundNs(local));
                Assert.IsTrue(i == 3 || clock.PollPing(local)); // found out quickly
            }
            Assert.Less(Math.Abs(clock.SessionNs(local) - local - Offset - slept), 1_000_000);
            Assert.Less(clock.ErrorBoundNs(local), 1_000_000);
        }

        /// <summary>Run one exchange that starts at `localNs`; return the local time of its end.</summary>
        private static long Exchange(ClockSync clock, long localNs, long outNs, long backNs, long offsetNs = Offset)
        {
            long t1 = localNs + outNs + offsetNs;
            long end = localNs + outNs + backNs;
            clock.ProcessPong(localNs, t1, t1, end);
            return end;
        }
    }
}
