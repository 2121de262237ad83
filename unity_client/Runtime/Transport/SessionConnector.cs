// From what an app was given (a pairing file, an address, a link, or nothing but a network) to a running session.
//
//     engine's thread                       thread of the connector
//     Enter, Choose, Trust, ...  --orders-->  locate, pair, compare keys, join (SessionConnector.Running)
//     Poll                       <--view----  phase, words, client
//
// All calls belong to one thread, the engine's. None waits but `Stop`; none throws what a network or a file did.
using System;
using System.Collections.Generic;
using System.Threading;

namespace IrisSession.Transport
{
    /// <summary>Finds a session, pairs with it, and joins it. Start it once, poll it each frame, stop it once.</summary>
    public sealed partial class SessionConnector
    {
        /// <summary>Longest time of <see cref="Stop"/>: scene and client need less than a second each, and together when a network is stuck.</summary>
        private const int StopMs = 2_000;

        private readonly ConnectorSettings settings;
        private readonly Thread thread;
        private readonly object gate = new object(); // guards orders, and wakes the thread
        private readonly Queue<Action> orders = new Queue<Action>();
        private volatile ConnectorView newest = ConnectorView.Idle;
        private volatile bool isStopping;
        private volatile bool isPaused;

        /// <param name="settings">With an identity and a cache.</param>
        public SessionConnector(ConnectorSettings settings)
        {
            this.settings = settings;
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session connector" };
        }

        /// <summary>What it does now, as of the last <see cref="Poll"/>.</summary>
        public ConnectorView View { get; private set; } = ConnectorView.Idle;

        /// <summary>The session, null unless `Running`. This starts and stops it.</summary>
        public SessionClient Client { get { return View.Client; } }

        /// <summary>The scene of <see cref="Client"/>, null with it.</summary>
        public SceneFetcher Scene { get { return View.Scene; } }

        public void Start()
        {
            thread.Start();
        }

        /// <summary>Leave the session and end all threads. Returns within about a second, two when a network is stuck: whether they have ended.</summary>
        public bool Stop()
        {
            lock (gate)
            {
                isStopping = true;
                Monitor.PulseAll(gate);
            }
            View = ConnectorView.Idle;
            return (thread.ThreadState & ThreadState.Unstarted) != 0 || thread.Join(StopMs);
        }

        /// <summary>The app is in the background, or no longer: meanwhile no session is joined, and one that is lost is not looked for elsewhere.</summary>
        public void SetPaused(bool isPaused)
        {
            this.isPaused = isPaused;
        }

        /// <summary>Take what happened. Call it each frame: it waits for nothing, and allocates nothing.</summary>
        /// <returns>Whether <see cref="View"/> is another one.</returns>
        public bool Poll()
        {
            ConnectorView now = newest;
            if (now == View || isStopping) return false;
            View = now;
            return true;
        }

        /// <summary>Join one of `View.Sessions`.</summary>
        public void Choose(OfferedSession session)
        {
            Order(() => goal.Chosen = session);
        }

        /// <summary>Leave what is there and go to an address or link, typed or scanned; one with a join code pairs. Empty: sessions that announce themselves.</summary>
        public void Enter(string address)
        {
            Order(() => goal = new ConnectorGoal(null, address) { PairsFirst = true, MayBeUsed = true });
        }

        /// <summary>Pair by a join code, as typed, with the session whose key is not known, or that refused this headset.</summary>
        public void EnterCode(string code)
        {
            Order(() =>
            {
                if (goal.Fault.What.Length > 0) goal = new ConnectorGoal(null, ""); // sessions that announce themselves, in place of what cannot be used
                goal.Code = code;
                goal.PairsFirst = true;
                goal.MayBeUsed = false;
            });
        }

        /// <summary>Accept the key whose `View.Fingerprint` the person has compared, and join.</summary>
        public void Trust()
        {
            string compared = View.Fingerprint;
            Order(() => TrustShown(compared));
        }

        /// <summary>Begin again with what was given or entered last.</summary>
        public void Retry()
        {
            Order(() => goal.Chosen = null);
        }

        // --- orders, and waits that they end ----------------------------------------------------------------------------------------

        private void Order(Action change)
        {
            lock (gate)
            {
                orders.Enqueue(change);
                Monitor.PulseAll(gate);
            }
        }

        private void TakeOrders()
        {
            while (true)
            {
                Action order;
                lock (gate)
                {
                    if (orders.Count == 0) return;
                    order = orders.Dequeue();
                }
                order();
            }
        }

        /// <summary>`gate` is held. To stop is no order that could be taken before a wait begins.</summary>
        private bool HasNoOrder { get { return orders.Count == 0 && !isStopping; } }

        /// <summary>Wait for a time. False: there is an order, or it is to stop.</summary>
        private bool Wait(int milliseconds)
        {
            lock (gate)
            {
                if (HasNoOrder) Monitor.Wait(gate, milliseconds);
                return HasNoOrder;
            }
        }

        private bool WaitFor(Func<bool> condition)
        {
            while (!condition()) if (!Wait(LookMs)) return false;
            return true;
        }

        private void WaitForOrder()
        {
            lock (gate) while (HasNoOrder) Monitor.Wait(gate);
        }
    }
}
