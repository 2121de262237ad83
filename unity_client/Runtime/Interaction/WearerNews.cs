// What the wearer has to hear of, each with when it came on the clock of readings [ns]: panels show it for a while.
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>The newest of each kind. For one thread.</summary>
    public sealed class WearerNews
    {
        private const long Never = long.MinValue / 2;

        /// <summary>Null before the first.</summary>
        public Denial Denial { get; private set; }

        public long DenialNs { get; private set; } = Never;

        /// <summary>Words of the session, of the gateway, or about a call that could not be done.</summary>
        public string Notice { get; private set; } = "";

        public long NoticeNs { get; private set; } = Never;

        /// <summary>What happened to the headset itself.</summary>
        public HeadsetEvent Event { get; private set; }

        public long EventNs { get; private set; } = Never;

        internal void Set(Denial denial, long nowNs)
        {
            Denial = denial;
            DenialNs = nowNs;
        }

        internal void Set(string notice, long nowNs)
        {
            Notice = notice;
            NoticeNs = nowNs;
        }

        internal void Set(HeadsetEvent one, long nowNs)
        {
            Event = one;
            EventNs = nowNs;
        }
    }
}
