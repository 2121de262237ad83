// Assets of a gateway: ranged GETs, one after the other on one connection, of which several are under way at once. docs/protocol.md, web
// channel, is normative.
using System;
using System.Collections.Generic;
using System.Globalization;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>One connection, opened with the first request. See <see cref="IAssetChannel"/>.</summary>
    internal sealed class HttpAssetChannel : IAssetChannel
    {
        /// <summary>Most bytes of a chunk.</summary>
        private const int MaxChunkBytes = 1 << 20;

        /// <summary>Time for an answer: the gateway fetches an asset from the session first [ns].</summary>
        private const long AnswerNs = 15_000_000_000;
        private const int MaxAdvice = 512;

        private readonly WebTransport transport;
        private readonly WebEndpoint endpoint;
        private readonly Interrupt interrupt = new Interrupt();
        private readonly Queue<ChunkRequest> pending = new Queue<ChunkRequest>();
        private HttpConnection connection;
        private bool isLost;

        public HttpAssetChannel(WebTransport transport, WebEndpoint endpoint)
        {
            this.transport = transport;
            this.endpoint = endpoint;
        }

        public bool IsCurrent { get { return !isLost && transport.FindTicket(endpoint).Length > 0; } }

        public bool TryRequest(ChunkRequest request)
        {
            return Guard(() =>
            {
                string ticket = transport.FindTicket(endpoint);
                if (ticket.Length == 0) throw new TransportException(LinkFailure.None, "the connection has ended");
                foreach (char unit in ticket) if (unit <= ' ' || unit > '~') throw new TransportException(LinkFailure.Protocol, "a ticket that is no text of a header");
                if (connection == null) connection = new HttpConnection(endpoint, interrupt);
                connection.SetDeadline(MonotonicClock.NowNs + AnswerNs);
                long last = request.Offset + request.Length - 1;
                connection.SendRequest("/v1/asset/" + request.Address, "X-Iris-Ticket: " + ticket + "\r\nRange: bytes=" + request.Offset + "-" + last + "\r\n");
                pending.Enqueue(request);
            });
        }

        public bool TryReceive(AssetAnswer answer)
        {
            return Guard(() =>
            {
                if (connection == null || pending.Count == 0) throw new TransportException(LinkFailure.None, "nothing was requested");
                connection.SetDeadline(MonotonicClock.NowNs + AnswerNs);
                answer.Request = pending.Dequeue();
                answer.Count = 0;
                answer.Reason = answer.Advice = "";
                HttpHead head = connection.ReadHead();
                if (head.Status == 206 || head.Status == 200) ReadBytes(head, answer);
                else ReadRefusal(head, answer);
                // What was sent behind it is not answered: the loader requests it again.
                isLost = head["Connection"].IndexOf("close", StringComparison.OrdinalIgnoreCase) >= 0;
            });
        }

        public void Abort()
        {
            interrupt.Set();
        }

        public void Dispose()
        {
            interrupt.Set();
            connection?.Dispose();
        }

        /// <summary>Read `bytes FIRST-LAST/TOTAL`. False: it is none.</summary>
        internal static bool TryReadRange(string text, out long first, out long last, out long total)
        {
            first = last = total = 0;
            int dash = text.IndexOf('-');
            int slash = text.IndexOf('/');
            return text.StartsWith("bytes ", StringComparison.Ordinal) && dash > 6 && slash > dash && text.Length < 64
                && TryReadNumber(text.Substring(6, dash - 6), out first) && TryReadNumber(text.Substring(dash + 1, slash - dash - 1), out last)
                && TryReadNumber(text.Substring(slash + 1), out total) && first <= last && last < total;
        }

        private static bool TryReadNumber(string text, out long number)
        {
            return long.TryParse(text, NumberStyles.None, CultureInfo.InvariantCulture, out number) && number < 1L << 50;
        }

        private void ReadBytes(HttpHead head, AssetAnswer answer)
        {
            long length = head.ContentLength;
            long last = length - 1;
            answer.Offset = 0;
            answer.Total = length;
            bool isRange = head.Status == 206;
            bool fits = !isRange || TryReadRange(head["Content-Range"], out answer.Offset, out last, out answer.Total);
            if (!fits || length < 0 || length > MaxChunkBytes || last - answer.Offset + 1 != length) throw new TransportException(LinkFailure.Protocol, "a part of an asset whose length does not fit its range");
            if (answer.Bytes.Length < length) answer.Bytes = new byte[length];
            connection.ReadBody(answer.Bytes, (int)length);
            answer.Count = (int)length;
        }

        private void ReadRefusal(HttpHead head, AssetAnswer answer)
        {
            string words = connection.ReadText(head, MaxAdvice);
            if (head.Status == 416 && head["Content-Range"] == "bytes */0")
            {
                answer.Offset = answer.Total = 0; // an asset without bytes
                return;
            }
            answer.Advice = words;
            answer.Reason = GetReason(head.Status);
        }

        private static string GetReason(int status)
        {
            switch (status)
            {
                case 404: return AssetRefusal.Unknown;
                case 416: return AssetRefusal.BadRange;
                case 401:
                case 403: return AssetRefusal.NotAllowed;
                case 429: return AssetRefusal.TooMany;
                default: return AssetRefusal.Busy;
            }
        }

        private bool Guard(Action action)
        {
            if (isLost || interrupt.IsSet) return false;
            try
            {
                action();
                return true;
            }
            catch (Exception error) when (HttpConnection.IsOfConnection(error))
            {
                isLost = true;
                return false;
            }
        }
    }
}
