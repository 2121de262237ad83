// Estimate of session time from four-timestamp exchanges. Pure: the caller passes its own monotonic clock in.
//
// Each exchange gives an offset `((t1 - t0) + (t2 - t3)) / 2` whose error is at most half its round trip, for any asymmetry of the
// path, plus drift since. The estimate is the median offset of the quickest quarter of a window, kept within the intersection of
// those intervals (Marzullo), which is also the stated error bound. After the first exchange it is slewed, so that session time does
// not run backwards. It is stepped only when the exchanges prove it impossible, as after sleep of the machine.
using System;

namespace IrisSession.Core
{
    /// <summary>Maps the client's monotonic clock to session time. All times are whole nanoseconds.</summary>
    public sealed class ClockSync
    {
        private struct Exchange
        {
            public long AtNs;
            public long OffsetNs;
            public long RttNs;
        }

        /// <summary>Exchanges; a quarter of a minute at two per second.</summary>
        private const int Window = 32;

        /// <summary>Older exchanges no longer count.</summary>
        private const long MaxAgeNs = 60_000_000_000;

        /// <summary>Exchanges before the estimate is used: a single one may have been delayed by a busy machine.</summary>
        private const int Settled = 4;

        /// <summary>The estimate moves by 10 ms per second: invisible in 150 ms freshness, monotonic.</summary>
        private const double Slew = 0.01;

        /// <summary>Samples from further in the future are rejected, so larger corrections are slewed by 100 ms per second.</summary>
        private const long LargeNs = 5_000_000;
        private const double SlewLarge = 0.1;

        /// <summary>Two quartz clocks of +-50 ppm each.</summary>
        private const double Drift = 100e-6;

        /// <summary>Exchanges in a row that contradict all earlier ones: the local clock has jumped.</summary>
        private const int Jump = 4;

        /// <summary>Exchanges at the start and after a reset, at the shorter period, then at the longer one.</summary>
        private const int Burst = 8;
        private const long BurstPeriodNs = 5_000_000;
        private const long PeriodNs = 500_000_000;

        /// <summary>Times beyond this are no times: 36 years.</summary>
        private const long MaxTimeNs = 1L << 60;

        private readonly Exchange[] window = new Exchange[Window];
        private readonly Exchange[] contradicting = new Exchange[Jump];
        private readonly Exchange[] quickest = new Exchange[Window];
        private readonly long[] offsets = new long[Window];
        private int count;
        private int contradictions;
        private long target;
        private long offset;
        private long offsetAt;

        // No exchange agrees with this interval, so the first one is taken as it is.
        private long low = long.MaxValue;
        private long high = long.MinValue;
        private int sent;

        /// <summary>Exchanges that are impossible.</summary>
        public long Rejected { get; private set; }

        /// <summary>True after the first exchange.</summary>
        public bool IsSynced { get { return count > 0; } }

        /// <summary>True when there were enough exchanges to stamp samples.</summary>
        public bool IsSettled { get { return count >= Settled; } }

        /// <summary>Shortest round trip in the window [ns], 0 before the first exchange.</summary>
        public long RttNs { get; private set; }

        /// <summary>Time at which the next ping is due [local ns].</summary>
        public long NextPingNs { get; private set; }

        /// <summary>Clear everything, for another session.</summary>
        public void Reset()
        {
            target = offset = offsetAt = RttNs = 0;
            low = long.MaxValue;
            high = long.MinValue;
            Restart();
        }

        /// <summary>Measure again after a new connection to the session: the machine may have slept.</summary>
        public void Restart()
        {
            count = contradictions = sent = 0;
            NextPingNs = 0;
        }

        /// <summary>Return whether a `clock_ping` is to be sent now, and count it as sent.</summary>
        public bool PollPing(long localNs)
        {
            if (localNs < NextPingNs) return false;
            sent++;
            NextPingNs = localNs + (sent < Burst ? BurstPeriodNs : PeriodNs);
            return true;
        }

        /// <summary>Count one exchange: `t0`, `t3` on the client's clock, `t1`, `t2` in session time. Impossible ones are rejected.</summary>
        public void ProcessPong(long t0Ns, long t1Ns, long t2Ns, long t3Ns)
        {
            if (!IsTime(t0Ns) || !IsTime(t1Ns) || !IsTime(t2Ns) || !IsTime(t3Ns) || t3Ns < t0Ns || t2Ns < t1Ns || t3Ns - t0Ns < t2Ns - t1Ns)
            {
                Rejected++;
                return;
            }
            Exchange exchange = new Exchange { AtNs = t3Ns, OffsetNs = (t1Ns - t0Ns + (t2Ns - t3Ns)) >> 1, RttNs = t3Ns - t0Ns - (t2Ns - t1Ns) };
            bool jumped;
            if (IsSynced && IsContradicted(exchange))
            {
                contradicting[contradictions++] = exchange;
                if (contradictions < Jump)
                {
                    sent = 0; // another burst
                    NextPingNs = Math.Min(NextPingNs, t3Ns);
                    return;
                }
                count = Jump - 1;
                Array.Copy(contradicting, window, count);
                jumped = true;
            }
            else jumped = !IsSynced && IsContradicted(exchange);
            contradictions = 0;
            if (count == Window) Array.Copy(window, 1, window, 0, --count);
            window[count++] = exchange;
            Estimate(t3Ns, jumped);
        }

        /// <summary>Return session time at `localNs`. Meaningless before <see cref="IsSynced"/>.</summary>
        public long SessionNs(long localNs)
        {
            return localNs + SlewedOffset(localNs);
        }

        /// <summary>Return the client's clock at session time `sessionNs`, by the present estimate.</summary>
        public long LocalNs(long sessionNs)
        {
            return sessionNs - target;
        }

        /// <summary>Return the bound of the error of `SessionNs(localNs)`: round trips, drift, and remaining slew.</summary>
        public long ErrorBoundNs(long localNs)
        {
            if (!IsSynced) return long.MaxValue;
            long now = SlewedOffset(localNs);
            long least = low;
            long most = high;
            for (int i = 0; i < contradictions; i++)
            {
                long reach = Uncertainty(contradicting[i], localNs); // these may be right
                least = Math.Min(least, contradicting[i].OffsetNs - reach);
                most = Math.Max(most, contradicting[i].OffsetNs + reach);
            }
            return Math.Max(most - now, now - least) + (long)(Drift * Math.Abs(localNs - offsetAt));
        }

        private static bool IsTime(long ns)
        {
            return ns > -MaxTimeNs && ns < MaxTimeNs;
        }

        /// <summary>Return whether this exchange and the estimate cannot both be right.</summary>
        private bool IsContradicted(Exchange exchange)
        {
            long reach = Uncertainty(exchange, exchange.AtNs) + (long)(Drift * (exchange.AtNs - offsetAt));
            return exchange.OffsetNs + reach < low || exchange.OffsetNs - reach > high;
        }

        private void Estimate(long nowNs, bool jumped)
        {
            long before = SlewedOffset(nowNs);
            int fresh = SortFresh(nowNs);
            Intersect(fresh, nowNs);
            int used = Math.Max(1, fresh / 4);
            for (int i = 0; i < used; i++) offsets[i] = quickest[i].OffsetNs;
            Array.Sort(offsets, 0, used);
            long middle = used % 2 == 1 ? offsets[used / 2] : (offsets[used / 2 - 1] + offsets[used / 2]) / 2;
            target = Math.Max(low, Math.Min(high, middle));
            RttNs = quickest[0].RttNs;
            offset = jumped ? target : before;
            offsetAt = nowNs;
        }

        /// <summary>Write the exchanges that count to `quickest`, shortest round trip first. Returns their number.</summary>
        private int SortFresh(long nowNs)
        {
            int fresh = 0;
            for (int i = 0; i < count; i++)
            {
                if (nowNs - window[i].AtNs > MaxAgeNs) continue;
                int at = fresh++;
                for (; at > 0 && quickest[at - 1].RttNs > window[i].RttNs; at--) quickest[at] = quickest[at - 1];
                quickest[at] = window[i];
            }
            return fresh;
        }

        /// <summary>Find the lowest and highest offset that agree with the exchanges, quickest first, without contradicting ones.</summary>
        private void Intersect(int fresh, long nowNs)
        {
            low = long.MinValue;
            high = long.MaxValue;
            for (int i = 0; i < fresh; i++)
            {
                long reach = Uncertainty(quickest[i], nowNs);
                long offsetNs = quickest[i].OffsetNs;
                if (offsetNs - reach > high || offsetNs + reach < low) continue;
                low = Math.Max(low, offsetNs - reach);
                high = Math.Min(high, offsetNs + reach);
            }
        }

        private long SlewedOffset(long localNs)
        {
            long elapsed = Math.Max(0, localNs - offsetAt);
            long way = target - offset;
            double quick = Math.Min(elapsed, Math.Max(0, Math.Abs(way) - LargeNs) / SlewLarge); // nanoseconds of quick movement
            long room = (long)(SlewLarge * quick + Slew * (elapsed - quick));
            return offset + Math.Max(-room, Math.Min(room, way));
        }

        /// <summary>Return how far the offset can be from that of an exchange [ns].</summary>
        private static long Uncertainty(Exchange exchange, long nowNs)
        {
            return exchange.RttNs / 2 + (long)(Drift * (nowNs - exchange.AtNs)) + 1;
        }
    }
}
