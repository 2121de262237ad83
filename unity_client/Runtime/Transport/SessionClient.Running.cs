using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    // What runs on the thread of the session.
    public sealed partial class SessionClient
    {
        /// <summary>Requests that wait for their reply: number on the wire and ticket of the engine.</summary>
        private readonly List<KeyValuePair<long, long>> requests = new List<KeyValuePair<long, long>>();
        private readonly Queue<SessionNews> ownNews = new Queue<SessionNews>(); // replies and notices that wait for room
        private int requestGeneration;
        private long statesReplaced;
        private long newsDropped;
        private long callsInvalid;
        private string newestInvalid = "";
        private readonly List<Advice> adviceNow = new List<Advice>();
        private long adviceAt = long.MinValue;
        private long seenSnapshots = -1;
        private Refused seenRefusal;
        private readonly MediaHeader mediaHeader = new MediaHeader();
        private readonly WireReader mediaReader = new WireReader();

        private void Run()
        {
            try
            {
                while (!isStopping)
                {
                    TakeCalls();
                    loop.Step();
                    Publish();
                    transport.Wait((int)Math.Min(LongestWaitMs, (loop.NextWaitNs() + 999_999) / 1_000_000));
                }
            }
            catch (Exception error)
            {
                crash = error.ToString(); // a defect of ours: the engine goes on without a session
            }
            Guard(Leave);
            if (crash.Length > 0) loop.NoteDefect();
            adviceAt = long.MinValue;
            Guard(PublishView);
            Guard(PublishAdvice);
            transport.Dispose();
        }

        /// <summary>Send an e-stop that was pressed last, and leave.</summary>
        private void Leave()
        {
            TakeStop();
            loop.Close();
        }

        private void Guard(Action action)
        {
            try
            {
                action();
            }
            catch (Exception error)
            {
                crash += error;
            }
        }

        private void TakeCalls()
        {
            TakeStop();
            while (calls.HasNews)
            {
                SessionCall call = calls.Oldest;
                try
                {
                    Do(call);
                }
                catch (Exception error)
                {
                    // Actions and messages of the application may throw anything. The session goes on: the next call may be an e-stop.
                    NoteInvalid(call, error.Message);
                }
                call.Clear();
                calls.Remove();
            }
            TakeOwed();
        }

        /// <summary>Do what <see cref="Post"/> has kept, now that all calls before it are done.</summary>
        private void TakeOwed()
        {
            while (true)
            {
                Action<SessionLoop> action;
                lock (owed)
                {
                    if (owed.Count == 0) return;
                    action = owed.Dequeue();
                }
                try
                {
                    action(loop);
                }
                catch (Exception error)
                {
                    Interlocked.Increment(ref callsInvalid);
                    AddNews(new SessionNews { Kind = NewsKind.Notice, Text = error.Message });
                }
            }
        }

        /// <summary>Count a call that could not be done and say why; of samples that repeat each frame, once.</summary>
        private void NoteInvalid(SessionCall call, string text)
        {
            Interlocked.Increment(ref callsInvalid);
            bool isRepeated = call.Kind != CallKind.Action && text == newestInvalid;
            newestInvalid = text;
            if (call.Kind == CallKind.Request) AddNews(new SessionNews { Kind = NewsKind.Reply, Ticket = call.Ticket, Text = text });
            else if (!isRepeated) AddNews(new SessionNews { Kind = NewsKind.Notice, Text = text });
        }

        private void Do(SessionCall call)
        {
            switch (call.Kind)
            {
                case CallKind.Sample:
                    loop.SendSample(call.Sample);
                    break;
                case CallKind.Sighting:
                    loop.Alignment.Observe(call.Sighting);
                    break;
                case CallKind.Request:
                    long number = loop.Connection.Request(call.Message);
                    requests.Add(new KeyValuePair<long, long>(number, call.Ticket));
                    break;
                default:
                    call.Action(loop);
                    break;
            }
        }

        private void TakeStop()
        {
            EStop pressed = Interlocked.Exchange(ref stop, null);
            if (pressed == null) return;
            try
            {
                loop.Connection.Send(pressed);
            }
            catch (ClientException error)
            {
                AddNews(new SessionNews { Kind = NewsKind.Notice, Text = error.Message });
            }
        }

        private void Publish()
        {
            TakeReplies();
            while (ownNews.Count > 0 && news.HasRoom)
            {
                news.Next = ownNews.Dequeue();
                news.Add();
            }
            Inbox inbox = loop.Connection.Inbox;
            while (news.HasRoom && inbox.TryTake(out InboxMessage message))
            {
                loop.Note(message.Message);
                news.Next = new SessionNews { Kind = NewsKind.Message, Message = message };
                news.Add();
            }
            while (news.HasRoom && loop.Headset.TryTakeEvent(out HeadsetEvent happened))
            {
                news.Next = new SessionNews { Kind = NewsKind.Headset, Headset = happened };
                news.Add();
            }
            ClockSync clock = loop.Connection.Clock;
            if (clock.IsSynced)
            {
                long nowNs = MonotonicClock.NowNs;
                Interlocked.Exchange(ref clockOffsetNs, clock.SessionNs(nowNs) - nowNs);
            }
            Interlocked.Exchange(ref isClockSynced, clock.IsSettled ? 1 : 0);
            PublishView();
            PublishAdvice();
        }

        /// <summary>Publish what is wrong when it has changed, a few times a second.</summary>
        private void PublishAdvice()
        {
            suspensions = loop.Headset.Suspensions;
            isLive = loop.Headset.IsLive;
            long nowNs = MonotonicClock.NowNs;
            if (nowNs < adviceAt) return;
            adviceAt = nowNs + AdvicePeriodNs;
            loop.ListAdvice(adviceNow);
            Advice[] before = advice;
            bool isSame = before.Length == adviceNow.Count;
            for (int i = 0; isSame && i < before.Length; i++)
            {
                Advice one = adviceNow[i];
                isSame = one.Kind == before[i].Kind && one.Reason == before[i].Reason && one.Phrase.What == before[i].Phrase.What && one.Phrase.Remedy == before[i].Phrase.Remedy;
            }
            if (!isSame) advice = adviceNow.ToArray();
        }

        private void TakeReplies()
        {
            PendingRequests pending = loop.Connection.Requests;
            bool isLost = requestGeneration != loop.Connection.Generation; // those of another connection get no reply
            requestGeneration = loop.Connection.Generation;
            for (int i = 0; i < requests.Count;)
            {
                Reply reply = pending.PopReply(requests[i].Key);
                bool waits = reply == null && pending.IsPending(requests[i].Key);
                if (waits)
                {
                    i++;
                    continue;
                }
                if (reply != null) loop.Note(reply);
                string text = reply != null ? "" : isLost ? "the connection was lost before the session answered" : "too many requests wait for an answer";
                AddNews(new SessionNews { Kind = NewsKind.Reply, Ticket = requests[i].Value, Reply = reply, Text = text });
                requests.RemoveAt(i);
            }
        }

        /// <summary>Keep what is no message of the session until there is room. Beyond the bound the oldest is dropped, and counted.</summary>
        private void AddNews(SessionNews one)
        {
            if (ownNews.Count == MaxRequests)
            {
                ownNews.Dequeue();
                Interlocked.Increment(ref newsDropped);
            }
            ownNews.Enqueue(one);
        }

        private void TakeMedia(ref Multipart message)
        {
            try
            {
                if (message.Count != 3) throw new WireException("a media message of " + message.Count + " frames");
                mediaReader.Reset(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                mediaReader.ReadInto(mediaHeader);
                mediaReader.ExpectEnd();
            }
            catch (WireException)
            {
                transport.Counters.Malformed++;
                return;
            }
            long ageNs = loop.Connection.Clock.SessionNs(MonotonicClock.NowNs) - mediaHeader.CaptureNs;
            loop.Meter.RecordMedia((int)message.TotalBytes, Math.Max(0, ageNs));
            media.Put(ref message);
        }

        private void PublishView()
        {
            SessionView before = view;
            ClientConnection connection = loop.Connection;
            SessionMirror mirror = connection.Mirror;
            bool isSame = before.Phase == connection.Phase && before.IsStalled == connection.IsStalled && before.Failure == connection.Failure
                && before.Problem.Failure == loop.Problem.Failure && before.Endpoint == loop.Endpoints.Current && before.Welcome == connection.Welcome
                && before.IsSynced == mirror.IsSynced && before.EventSeq == mirror.EventSeq && seenSnapshots == connection.Counters.Snapshots
                && seenRefusal == connection.RetryableRefusal && before.Budget == connection.Budget && before.Alignment == loop.Alignment.Current;
            if (isSame) return;
            seenRefusal = connection.RetryableRefusal;
            seenSnapshots = connection.Counters.Snapshots;
            view = new SessionView(loop, before);
        }

        private sealed class Listener : ISessionListener
        {
            private readonly SessionClient client;

            public Listener(SessionClient client)
            {
                this.client = client;
            }

            public void OnState(SessionLoop loop)
            {
                client.PublishView(); // its bodies come first
                client.states.Back.Fill(loop.Connection.Stream, client.view.BodiesVersion);
                if (client.states.Publish()) Interlocked.Increment(ref client.statesReplaced);
            }

            public void OnPresence(SessionLoop loop)
            {
                client.presence.Back.Fill(loop.Connection.Stream.Presence);
                client.presence.Publish();
            }

            public void OnMedia(SessionLoop loop, ref Multipart message)
            {
                client.TakeMedia(ref message);
            }

            public void OnNotice(SessionLoop loop, string text)
            {
                client.AddNews(new SessionNews { Kind = NewsKind.Notice, Text = text });
            }
        }
    }
}
