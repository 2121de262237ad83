using IrisSession.Core;

namespace IrisSession.Transport
{
    // What was lost on the way, for a log.
    public sealed partial class SessionClient
    {
        private readonly long[] losses = new long[9]; // that were said

        /// <summary>Return on one line which losses have grown since the last call, and by how many; null: none has.</summary>
        public string DescribeLosses()
        {
            // Of the other thread: as they were a moment ago.
            ConnectionCounters counters = loop.Connection.Counters;
            string line = "";
            Append(ref line, 0, CallsDropped, "calls dropped, as too many waited");
            Append(ref line, 1, CallsInvalid, "calls that could not be done");
            Append(ref line, 2, NewsDropped, "news dropped, as nothing took them");
            Append(ref line, 3, counters.SamplesNotSent, "samples not sent");
            Append(ref line, 4, counters.OutgoingDropped, "messages dropped, as the session does not read");
            Append(ref line, 5, counters.InboxDropped, "messages of the session dropped, as nothing took them");
            Append(ref line, 6, transport.Counters.ControlOverflows, "connections closed, as their messages were not taken");
            Append(ref line, 7, loop.Headset.ImplausiblePoses, "poses that no device can have");
            Append(ref line, 8, loop.Headset.DroppedEvents, "events of the headset dropped");
            return line.Length > 0 ? line : null;
        }

        private void Append(ref string line, int index, long count, string what)
        {
            if (count != losses[index]) line += (line.Length > 0 ? "; " : "") + what + ": " + (count - losses[index]);
            losses[index] = count;
        }
    }
}
