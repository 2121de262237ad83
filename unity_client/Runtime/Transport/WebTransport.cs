// The web wire: control, state and presence over one WebSocket, media over another one. docs/protocol.md, web channel, is normative.
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Sockets to a gateway. See <see cref="ITransport"/>.</summary>
    public sealed class WebTransport : ITransport, ILinkListener
    {
        /// <summary>Largest messages: a snapshot and its poses of 65,535 bodies; a media frame and its header.</summary>
        private const int MaxControlBytes = 36 << 20;
        private const int MaxMediaBytes = (8 << 20) + 4096;

        /// <summary>Control messages that wait to be taken.</summary>
        private const int MaxWaiting = 1024;
        private const long MaxWaitingBytes = 64 << 20;
        private const int MaxStreams = 16;

        /// <summary>Pauses before media are opened again after they were closed; doubled each time until something comes.</summary>
        private const long FirstPauseNs = 200_000_000;
        private const long LongestPauseNs = 5_000_000_000;

        /// <summary>Longest time of <see cref="Dispose"/>: threads look every 50 ms whether they are to end, and linger for 500 ms.</summary>
        private const int DisposeMs = 900;

        private readonly AutoResetEvent news = new AutoResetEvent(false);
        private readonly object gate = new object(); // guards links, ticket, notice and probe; held for moments
        private readonly MessageQueue control = new MessageQueue(MaxWaiting, MaxWaitingBytes);
        private readonly NewestMessages state = new NewestMessages(4, false);
        private readonly NewestMessages media = new NewestMessages(MaxStreams, true);
        private readonly List<WebSocketLink> ending = new List<WebSocketLink>();
        private readonly List<string> wishes = new List<string>();
        private WebEndpoint endpoint;
        private WebSocketLink controlLink;
        private WebSocketLink mediaLink;
        private string ticket = "";
        private string mediaTicket = ""; // that of the newest media link
        private bool isMediaGreeted; // it has our ticket and wishes
        private string notice;
        private long mediaEpoch;
        private long mediaPauseNs = FirstPauseNs;
        private long mediaAt; // not before
        private GatewayProbe probe;

        public TransportCounters Counters { get; } = new TransportCounters();

        public TransportState State
        {
            get
            {
                WebSocketLink link = controlLink;
                if (link == null || link.HasEnded) return TransportState.Closed;
                return link.IsOpen ? TransportState.Open : TransportState.Opening;
            }
        }

        public LinkEnd End { get { return controlLink == null ? default : controlLink.End; } }

        public string Ticket { get { lock (gate) return ticket; } }

        public void Open(WebEndpoint endpoint)
        {
            Close();
            lock (gate) this.endpoint = endpoint;
            Counters.Opened++;
            WebSocketLink link = new WebSocketLink(endpoint, "/v1/session", MaxControlBytes, this);
            lock (gate)
            {
                controlLink = link;
                control.Clear();
                state.Clear();
            }
            link.Start();
        }

        public void Close()
        {
            CloseMedia();
            WebSocketLink link;
            lock (gate)
            {
                link = controlLink;
                controlLink = null;
                ticket = "";
                mediaEpoch = 0;
            }
            Retire(link);
        }

        public bool TrySend(byte[] bytes, int count)
        {
            return controlLink != null && controlLink.TrySend(WebMessage.Control, bytes, count);
        }

        public bool TryTakeControl(ref Multipart message)
        {
            return control.TryTake(ref message);
        }

        public bool TryTakeState(ref Multipart message)
        {
            bool came = state.TryTake(ref message);
            Counters.StateSuperseded = state.Superseded;
            return came;
        }

        public bool TryTakeMedia(ref Multipart message)
        {
            bool came = media.TryTake(ref message);
            if (came) mediaPauseNs = FirstPauseNs;
            Counters.MediaSuperseded = media.Superseded;
            return came;
        }

        public string TakeNotice()
        {
            lock (gate)
            {
                string taken = notice;
                notice = null;
                return taken;
            }
        }

        public void SetMedia(IReadOnlyList<string> streams, long connectionEpoch)
        {
            if (connectionEpoch != mediaEpoch) CloseMedia(); // it belongs to the connection before
            mediaEpoch = connectionEpoch;
            int count = Math.Min(streams.Count, MaxStreams);
            bool isSame = count == wishes.Count;
            for (int i = 0; i < count && isSame; i++) isSame = streams[i] == wishes[i];
            if (isSame) return;
            wishes.Clear();
            for (int i = 0; i < count; i++) wishes.Add(streams[i]);
            if (wishes.Count == 0 || (isMediaGreeted && !SendWishes())) CloseMedia();
        }

        public IAssetChannel OpenAssets()
        {
            lock (gate) return ticket.Length == 0 ? null : new HttpAssetChannel(this, endpoint);
        }

        /// <summary>Return the ticket of the connection to an endpoint, empty when it is not the present one.</summary>
        internal string FindTicket(WebEndpoint of)
        {
            lock (gate) return of == endpoint ? ticket : "";
        }

        public void StartProbe(WebEndpoint endpoint)
        {
            if (probe != null) return;
            probe = new GatewayProbe(endpoint, news);
            probe.Start();
        }

        public bool TryTakeProbe(out ProbeAnswer answer)
        {
            answer = default;
            if (probe == null || !probe.HasEnded) return false;
            answer = probe.Answer;
            probe = null;
            return true;
        }

        public long Tick(long nowNs)
        {
            ending.RemoveAll(each => each.Join(0));
            if (mediaLink != null && mediaLink.HasEnded) OnMediaEnd(nowNs);
            if (mediaLink != null && mediaLink.IsOpen && !isMediaGreeted) GreetMedia();
            bool isWanted = wishes.Count > 0 && mediaEpoch > 0 && mediaLink == null && endpoint != null;
            if (!isWanted) return long.MaxValue;
            string newest = Ticket;
            if (newest.Length == 0 || newest == mediaTicket) return long.MaxValue;
            if (nowNs < mediaAt) return mediaAt;
            mediaTicket = newest;
            Counters.MediaOpened++;
            WebSocketLink link = new WebSocketLink(endpoint, "/v1/media", MaxMediaBytes, this);
            lock (gate) mediaLink = link;
            link.Start();
            return long.MaxValue;
        }

        public void Wait(int milliseconds)
        {
            news.WaitOne(milliseconds);
        }

        public void Wake()
        {
            news.Set();
        }

        /// <summary>Close everything. Returns within a second; whether all threads have ended by then is in <see cref="HasEnded"/>.</summary>
        public void Dispose()
        {
            Close();
            probe?.Abort();
            long untilNs = MonotonicClock.NowNs + 1_000_000L * DisposeMs;
            foreach (WebSocketLink link in ending)
            {
                if (!link.Join(RemainingMs(untilNs) * 3 / 4)) link.Abort();
            }
            HasEnded = probe == null || probe.Join(RemainingMs(untilNs));
            foreach (WebSocketLink link in ending) HasEnded &= link.Join(RemainingMs(untilNs));
        }

        /// <summary>True after <see cref="Dispose"/> when no thread is left.</summary>
        public bool HasEnded { get; private set; }

        void ILinkListener.OnOpen(WebSocketLink link)
        {
            news.Set();
        }

        bool ILinkListener.OnMessage(WebSocketLink link, int channel, ref Multipart message)
        {
            bool isTaken;
            lock (gate) isTaken = (link != controlLink && link != mediaLink) || Take(channel, ref message);
            news.Set();
            return isTaken;
        }

        void ILinkListener.OnEnd(WebSocketLink link)
        {
            news.Set();
        }

        private static int RemainingMs(long untilNs)
        {
            return (int)Math.Max(0, (untilNs - MonotonicClock.NowNs) / 1_000_000);
        }

        /// <summary>Keep what came. False: it cannot be kept, and must not be dropped. `gate` is held.</summary>
        private bool Take(int channel, ref Multipart message)
        {
            switch (channel)
            {
                case WebMessage.Control:
                    if (control.TryAdd(ref message)) return true;
                    Counters.ControlOverflows++;
                    return false;
                case WebMessage.State:
                    state.Put(ref message);
                    return true;
                case WebMessage.Media:
                    media.Put(ref message);
                    return true;
                case WebMessage.Gateway:
                    TakeGatewayMessage(message);
                    return true;
                default:
                    return true; // of a newer gateway
            }
        }

        private void TakeGatewayMessage(Multipart message)
        {
            if (!WebMessage.TryReadGateway(message, out string newTicket, out string words))
            {
                Counters.Malformed++;
                return;
            }
            if (newTicket != null) ticket = newTicket;
            if (words == null) return;
            if (notice != null) Counters.NoticesDropped++;
            notice = words;
        }

        private void OnMediaEnd(long nowNs)
        {
            bool isRefused = mediaLink.End.Failure == LinkFailure.Closed && mediaLink.End.Code == CloseCode.NotAllowed;
            string shown = mediaTicket;
            CloseMedia();
            if (isRefused) mediaTicket = shown; // it is not valid: the next one comes with a welcome, or before this one expires
            mediaAt = nowNs + mediaPauseNs;
            mediaPauseNs = Math.Min(2 * mediaPauseNs, LongestPauseNs);
        }

        private void CloseMedia()
        {
            WebSocketLink link;
            lock (gate)
            {
                link = mediaLink;
                mediaLink = null;
            }
            Retire(link);
            mediaTicket = "";
            isMediaGreeted = false;
            media.Clear();
        }

        private void Retire(WebSocketLink link)
        {
            if (link == null) return;
            Counters.Malformed += link.Malformed;
            link.Stop();
            ending.Add(link);
        }

        private void GreetMedia()
        {
            byte[] frame = WebMessage.EncodeTicket(mediaTicket);
            isMediaGreeted = mediaLink.TrySend(WebMessage.Gateway, frame, frame.Length) && SendWishes();
        }

        private bool SendWishes()
        {
            byte[] frame = WebMessage.EncodeWishes(wishes);
            return mediaLink.TrySend(WebMessage.Wishes, frame, frame.Length);
        }
    }
}
