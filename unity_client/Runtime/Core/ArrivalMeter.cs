// Report of a client about itself, once a second: ages and gaps of the state that it passed on.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Collects ages and gaps of the state, media and frames drawn. Allocates nothing but the report.</summary>
    public sealed class ArrivalMeter
    {
        private const long PeriodNs = 1_000_000_000;

        /// <summary>Most ages per period: more frames than are ever sent in a second.</summary>
        private const int MaxAges = 512;

        private readonly long[] ages = new long[MaxAges];
        private readonly long[] mediaAges = new long[MaxAges];
        private int ageCount;
        private int mediaCount;
        private double ageMsP50;
        private double ageMsP99;
        private long shownNs = -1;
        private long delivered;
        private long missed;
        private long seq;
        private long bytes;
        private long sinceNs = -1;
        private long mediaBytes;
        private long drawn;

        /// <summary>
        /// Record the state that the stream has just handed out.
        ///
        /// One that is sent again, because its source is silent, is as old as that silence: its age does not count. The first of a
        /// connection may be one of those.
        /// </summary>
        public void RecordState(StateStream stream)
        {
            StateHeader header = stream.Header;
            if (seq > 0 && header.StateSeq > seq) missed += header.StateSeq - seq - 1;
            seq = header.StateSeq;
            delivered++;
            if (ageCount < MaxAges && shownNs != -1 && shownNs != header.SessionTime) ages[ageCount++] = stream.AgeNs;
            shownNs = header.SessionTime;
        }

        /// <summary>Record a frame of media.</summary>
        public void RecordMedia(int size, long ageNs)
        {
            mediaBytes += size;
            if (mediaCount < MaxAges) mediaAges[mediaCount++] = ageNs;
        }

        /// <summary>Record a frame that was drawn.</summary>
        public void RecordDrawn()
        {
            drawn++;
        }

        /// <summary>Begin anew, with another connection.</summary>
        public void Restart()
        {
            sinceNs = shownNs = -1;
            seq = 0;
            ageMsP50 = ageMsP99 = 0;
        }

        /// <summary>Return the report of the last second when it is due, else null.</summary>
        /// <param name="stream">Its counters say how many bytes came.</param>
        /// <param name="rttNs">Round trip of the connection [ns].</param>
        /// <param name="nowNs">A monotonic clock [ns].</param>
        public ClientReport Poll(StateStream stream, long rttNs, long nowNs)
        {
            long received = stream.Counters.BytesReceived;
            if (sinceNs < 0)
            {
                StartPeriod(received, nowNs);
                return null;
            }
            long elapsedNs = nowNs - sinceNs;
            if (elapsedNs < PeriodNs) return null;
            if (ageCount > 0 || delivered == 0)
            {
                Array.Sort(ages, 0, ageCount);
                ageMsP50 = QuantileMs(ages, ageCount, 50);
                ageMsP99 = QuantileMs(ages, ageCount, 99);
            }
            Array.Sort(mediaAges, 0, mediaCount);
            double seconds = elapsedNs * 1e-9;
            ClientReport report = new ClientReport
            {
                AgeMsP50 = ageMsP50,
                AgeMsP99 = ageMsP99,
                Delivered = delivered,
                Missed = missed,
                RttMs = rttNs * 1e-6,
                BytesPerS = (received - bytes) / seconds,
                MediaBytesPerS = mediaBytes / seconds,
                MediaAgeMs = QuantileMs(mediaAges, mediaCount, 50),
                DisplayHz = drawn / seconds,
            };
            StartPeriod(received, nowNs);
            return report;
        }

        private void StartPeriod(long received, long nowNs)
        {
            sinceNs = nowNs;
            bytes = received;
            ageCount = mediaCount = 0;
            delivered = missed = mediaBytes = drawn = 0;
        }

        /// <summary>Return a percentile of sorted durations [ns], in milliseconds; 0 without any.</summary>
        private static double QuantileMs(long[] sorted, int count, int percent)
        {
            if (count == 0) return 0;
            int at = percent == 50 ? (count - 1) >> 1 : ((count - 1) * percent + 99) / 100;
            return sorted[at] * 1e-6;
        }
    }
}
