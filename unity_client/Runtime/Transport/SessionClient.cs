// A session for an engine: connection and sockets on threads of their own, and calls that never wait for them.
//
//     engine's thread                                    thread of the session
//     TrySendSample, TryPost, Request  --HandOver-->     SessionLoop.Step
//     TakeState, TakePresence          <--TripleBuffer-- newest state, newest presence
//     TryTakeNews                      <--HandOver--     events, replies, notices
//     View                             <--reference--    the session, replaced when something changes
//
// All calls belong to one thread, the engine's. None allocates per frame; none throws what a session or a network did.
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>A client that an engine polls. Start it once, stop it once.</summary>
    public sealed partial class SessionClient
    {
        /// <summary>Calls that wait for the thread of the session: seconds of samples, as it runs every few milliseconds.</summary>
        private const int MaxCalls = 1024;

        /// <summary>Events, replies and notices that wait for the engine. Above, messages stay in the connection's inbox, which names what is missed.</summary>
        private const int MaxNews = 1024;

        /// <summary>Requests whose reply was not taken.</summary>
        private const int MaxRequests = 64;

        /// <summary>Calls that must not be lost and wait behind those: reports of a headset, a few each minute.</summary>
        private const int MaxOwed = 256;

        /// <summary>Longest sleep of the session's thread, so that its clock estimate reaches the engine [ms].</summary>
        private const int LongestWaitMs = 100;

        /// <summary>Advice is made anew so often: people read it [ns].</summary>
        private const long AdvicePeriodNs = 200_000_000;

        /// <summary>Longest time of <see cref="Stop"/>.</summary>
        private const int StopMs = 950;

        private readonly SessionLoop loop;
        private readonly ITransport transport;
        private readonly Thread thread;
        private readonly TripleBuffer<StateFrame> states = new TripleBuffer<StateFrame>(() => new StateFrame());
        private readonly TripleBuffer<PresenceFrame> presence = new TripleBuffer<PresenceFrame>(() => new PresenceFrame());
        private readonly HandOver<SessionCall> calls = new HandOver<SessionCall>(MaxCalls, () => new SessionCall());
        private readonly Queue<Action<SessionLoop>> owed = new Queue<Action<SessionLoop>>(); // guarded by itself; after all that is in `calls`
        private readonly HandOver<SessionNews> news = new HandOver<SessionNews>(MaxNews, () => default);
        private readonly NewestMessages media = new NewestMessages(16, true);
        private EStop stop; // handed over by itself: it never waits behind samples, and is never dropped
        private volatile SessionView view;
        private volatile Advice[] advice = new Advice[0];
        private volatile int suspensions;
        private volatile bool isLive = true;
        private volatile bool isStopping;
        private volatile string crash = "";
        private long clockOffsetNs;
        private long isClockSynced;
        private long tickets;

        /// <param name="hello">See <see cref="ClientConnection"/>.</param>
        /// <param name="identity">Called on the thread of the session.</param>
        /// <param name="endpoints">Addresses in the order of preference.</param>
        /// <param name="transport">Disposed of by <see cref="Stop"/>.</param>
        public SessionClient(Hello hello, IIdentityStore identity, EndpointChooser endpoints, ITransport transport)
        {
            this.transport = transport;
            loop = new SessionLoop(new ClientConnection(hello, identity), transport, endpoints, new Listener(this), () => MonotonicClock.NowNs);
            view = new SessionView(loop, null);
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session" };
        }

        /// <summary>The session as it is known now.</summary>
        public SessionView View { get { return view; } }

        /// <summary>What is wrong now, the most urgent first. Never changes: another list replaces it.</summary>
        public Advice[] Advice { get { return advice; } }

        /// <summary>`HeadsetState.Suspensions` and `IsLive`, as the thread of the session last had them.</summary>
        public int Suspensions { get { return suspensions; } }

        public bool IsLive { get { return isLive; } }

        /// <summary>The newest state, empty before the first. See <see cref="TakeState"/>.</summary>
        public StateFrame State { get { return states.Front; } }

        public PresenceFrame Presence { get { return presence.Front; } }

        /// <summary>See <see cref="ITransport.OpenAssets"/>.</summary>
        internal IAssetChannel OpenAssets()
        {
            return transport.OpenAssets();
        }

        /// <summary>Calls that were dropped because too many waited.</summary>
        public long CallsDropped { get; private set; }

        /// <summary>Calls that could not be done, such as samples with bad numbers or unknown robots: a notice says why.</summary>
        public long CallsInvalid { get { return Interlocked.Read(ref callsInvalid); } }

        /// <summary>Replies and notices that were dropped because the engine took none.</summary>
        public long NewsDropped { get { return Interlocked.Read(ref newsDropped); } }

        /// <summary>States that a newer one replaced before the engine took them.</summary>
        public long StatesReplaced { get { return Interlocked.Read(ref statesReplaced); } }

        /// <summary>Media frames that a newer one of their stream replaced before the engine took them.</summary>
        public long MediaReplaced { get { return media.Superseded + transport.Counters.MediaSuperseded; } }

        /// <summary>The error that ended the thread, empty while it runs as it should.</summary>
        public string Crash { get { return crash; } }

        /// <summary>True when the thread of the session has ended, or was never started.</summary>
        public bool HasEnded { get { return !thread.IsAlive; } }

        /// <summary>True when session time is known.</summary>
        public bool HasClock { get { return Interlocked.Read(ref isClockSynced) != 0; } }

        /// <summary>Return session time at a time of <see cref="MonotonicClock"/>.</summary>
        public long ToSessionNs(long localNs)
        {
            return localNs + Interlocked.Read(ref clockOffsetNs);
        }

        /// <summary>Start to join the session.</summary>
        public void Start()
        {
            TryPost(session => session.Open());
            thread.Start();
        }

        /// <summary>Leave the session and end all threads. Returns within a second: whether they have ended.</summary>
        public bool Stop()
        {
            isStopping = true;
            transport.Wake();
            if ((thread.ThreadState & ThreadState.Unstarted) == 0) return thread.Join(StopMs);
            transport.Dispose();
            return true;
        }

        /// <summary>Take the newest state as <see cref="State"/>. False: it is that already.</summary>
        public bool TakeState()
        {
            return states.TryTake();
        }

        /// <summary>Take the newest presence as <see cref="Presence"/>. False: it is that already.</summary>
        public bool TakePresence()
        {
            return presence.TryTake();
        }

        /// <summary>
        /// Take the newest media frame of some stream (topic, `MediaHeader`, bytes), in exchange for `message`. False: there is none, or the other
        /// thread hands one over at this moment. A thread of the application may call it, to decode there.
        /// </summary>
        public bool TryTakeMedia(ref Multipart message)
        {
            return media.TryTakeAtOnce(ref message);
        }

        /// <summary>Take the oldest event, reply or notice.</summary>
        public bool TryTakeNews(out SessionNews one)
        {
            one = default;
            if (!news.HasNews) return false;
            one = news.Oldest;
            news.Oldest = default;
            news.Remove();
            return true;
        }

        /// <summary>Send the input of a device, of which a copy is made. False: too many calls wait.</summary>
        public bool TrySendSample(SampleInput input)
        {
            if (!HasRoom()) return false;
            calls.Next.SetSample(input);
            return HandCall();
        }

        /// <summary>Report a sheet, of which a copy is made. False: too many calls wait.</summary>
        public bool TryObserve(SheetSighting sighting)
        {
            if (!HasRoom()) return false;
            calls.Next.SetSighting(sighting);
            return HandCall();
        }

        /// <summary>
        /// Do something on the thread of the session that must not be lost, such as a report of what the wearer or the system did. While too
        /// many calls wait it is kept, and later calls are refused, so that nothing is done out of order.
        /// </summary>
        public void Post(Action<SessionLoop> action)
        {
            if (HasRoomNow())
            {
                calls.Next.SetAction(action);
                HandCall();
                return;
            }
            lock (owed)
            {
                if (owed.Count < MaxOwed) owed.Enqueue(action);
                else CallsDropped++;
            }
            transport.Wake();
        }

        /// <summary>Do something on the thread of the session. What it throws becomes a notice. False: too many calls wait.</summary>
        public bool TryPost(Action<SessionLoop> action)
        {
            if (!HasRoom()) return false;
            calls.Next.SetAction(action);
            return HandCall();
        }

        /// <summary>Send a request. Returns its ticket, with which the reply comes as news; 0: too many calls wait.</summary>
        public long Request(ClientMessage message)
        {
            if (!HasRoom()) return 0;
            calls.Next.SetRequest(message, ++tickets);
            HandCall();
            return tickets;
        }

        /// <summary>
        /// Stop all robots. While a session is joined or being joined it is kept until the session has it, over any number of connections;
        /// before that, and after a refusal, a notice says that it went nowhere.
        /// </summary>
        /// <returns>False when the thread of the session has ended: nothing can be stopped from here any more.</returns>
        public bool EStop(string reason)
        {
            Interlocked.Exchange(ref stop, new EStop { Reason = reason });
            transport.Wake();
            return !HasEnded;
        }

        /// <summary>The e-stop that no session has, null for none. After the end of the thread.</summary>
        internal EStop UnsentStop { get { return HasEnded ? loop.Connection.PendingEStop.Message : null; } }

        /// <summary>Say how the scene is, so that advice has it. From any thread.</summary>
        internal void NoteScene(SceneFacts facts)
        {
            loop.Advice.Scene = facts;
        }

        private bool HasRoom()
        {
            if (HasRoomNow()) return true;
            CallsDropped++;
            return false;
        }

        private bool HasRoomNow()
        {
            if (!calls.HasRoom) return false;
            lock (owed) return owed.Count == 0; // held for moments
        }

        private bool HandCall()
        {
            calls.Add();
            transport.Wake();
            return true;
        }
    }
}
