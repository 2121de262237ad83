using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    // What runs on the thread of the connector: locate, pair, compare the key, join. A step returns false when it came to no good end: it
    // has said why then, and has waited until there is a reason to begin again.
    public sealed partial class SessionConnector
    {
        /// <summary>Sessions are heard five times a second: after the first one, others are waited for [ns].</summary>
        private const long OthersNs = 600_000_000;

        /// <summary>A client that has not joined within it says why [ns].</summary>
        private const long JoinNs = 1_000_000_000;

        /// <summary>Characters of a name, before the three dots of one that is longer: the protocol has room for 64.</summary>
        private const int MaxName = 60;

        /// <summary>With it an alignment outlives a loss of the connection (docs/protocol.md, `hello`).</summary>
        private const string RunPrefix = "run:";
        private const int LookMs = 10;
        private const int ListenLookMs = 50;
        private const int SlowLookMs = 100;

        private ConnectorGoal goal;
        private BeaconListener listener;
        private OfferedSession[] offers = new OfferedSession[0];
        private EStop unsent; // of a client before, to the session of this id
        private string unsentFor = "";
        private LinkEnd shown; // with the key that was shown for comparison, and the addresses of that session
        private List<WebEndpoint> shownBy;

        private void Run()
        {
            goal = new ConnectorGoal(settings.PairingFile, settings.Address);
            while (!isStopping)
            {
                try
                {
                    TakeOrders();
                    Pursue();
                }
                catch (Exception error) // a defect of ours: the app goes on without a session
                {
                    Fail(ConnectorWords.Defect, new LinkEnd(LinkFailure.Defect, 0, error.ToString()));
                }
            }
            StopListening();
        }

        private void Pursue()
        {
            if (goal.Fault.What.Length > 0)
            {
                Fail(goal.Fault);
                return;
            }
            List<WebEndpoint> endpoints = Locate();
            if (endpoints == null) return;
            bool isKnown = endpoints.Exists(one => !one.IsSecure || CertificateHash.AreEqual(settings.Identity.FindPin(one.Authority), one.Pin));
            if (goal.Code.Length > 0 && (goal.PairsFirst || !isKnown) && !Pair(endpoints)) return;
            bool hasKey = endpoints.Exists(one => !one.IsSecure || one.Pin != null);
            if (hasKey || CompareKey(endpoints)) Join(endpoints);
        }

        // --- where it is ------------------------------------------------------------------------------------------------------------

        /// <summary>Return where the session is, the best address first, with the keys that are known; null when it was not found.</summary>
        private List<WebEndpoint> Locate()
        {
            if (goal.File == null && goal.Links.Count == 0 && goal.Chosen == null && !Listen()) return null;
            StopListening();
            if (goal.File != null) return goal.ListFileEndpoints();
            List<WebEndpoint> endpoints = new List<WebEndpoint>();
            if (goal.Chosen != null) foreach (WebEndpoint one in goal.Chosen.Endpoints) endpoints.Add(settings.Identity.WithKnownPin(one));
            LinkEnd end = default;
            foreach (PairingLink link in goal.Links)
            {
                Search(link.ToString());
                GatewayFinder finder = new GatewayFinder(link);
                finder.Start();
                bool isDone = WaitFor(() => finder.IsDone);
                finder.Stop();
                if (!isDone) return null;
                if (finder.Endpoint == null) end = finder.End;
                else endpoints.Add(settings.Identity.WithKnownPin(finder.Endpoint));
            }
            if (endpoints.Count > 0) return endpoints;
            TryAgain(end);
            return null;
        }

        /// <summary>Wait until one of the sessions is chosen that announce themselves: by the person, or because it is the only one.</summary>
        private bool Listen()
        {
            if (listener == null)
            {
                listener = new BeaconListener(settings.BeaconPort);
                listener.Start();
            }
            Search("");
            List<string> others = new List<string>();
            long beganNs = MonotonicClock.NowNs;
            long heardNs = -1;
            while (Wait(ListenLookMs))
            {
                UpdateOffers(others);
                long nowNs = MonotonicClock.NowNs;
                if (offers.Length == 0) heardNs = -1;
                else if (heardNs < 0) heardNs = nowNs;
                bool isChoice = newest.Phase == ConnectorPhase.Choosing; // stays one, so that no session is joined while a person decides
                if (offers.Length > 1 || (isChoice && offers.Length > 0)) Publish(new ConnectorView(ConnectorPhase.Choosing, ConnectorWords.SeveralSessions, sessions: offers));
                else if (offers.Length == 0 && nowNs - beganNs >= settings.SilenceNs) Publish(new ConnectorView(ConnectorPhase.Searching, ConnectorWords.OfSilence(listener, settings.SessionName, others)));
                else if (offers.Length == 1 && nowNs - heardNs >= OthersNs)
                {
                    goal.Chosen = offers[0];
                    Publish(new ConnectorView(ConnectorPhase.Searching, ConnectorWords.None, session: goal.Session));
                    return true;
                }
            }
            return false;
        }

        /// <summary>List the sessions that can be joined as `offers`, and the names of the others.</summary>
        private void UpdateOffers(List<string> others)
        {
            others.Clear();
            List<OfferedSession> now = new List<OfferedSession>();
            foreach (FoundSession found in listener.ListSessions())
            {
                Beacon beacon = found.Beacon;
                bool isWanted = settings.SessionName.Length == 0 || beacon.SessionName == settings.SessionName;
                if (!isWanted || beacon.Web < 1 || beacon.Web > 65535) others.Add(beacon.SessionName);
                else
                {
                    OfferedSession before = Array.Find(offers, each => each.Id == beacon.SessionId && each.HeardAt == found.Addresses.Count);
                    OfferedSession one = before ?? new OfferedSession(found, settings.Identity, settings.UsesThisMachine);
                    if (one.Endpoints.Count > 0) now.Add(one);
                }
            }
            offers = now.ToArray();
        }

        private void StopListening()
        {
            listener?.Stop();
            listener = null;
            offers = new OfferedSession[0];
        }

        // --- whether it is the right one --------------------------------------------------------------------------------------------

        /// <summary>Pair by the code of the goal, and give `endpoints` the key.</summary>
        private bool Pair(List<WebEndpoint> endpoints)
        {
            PairingResult failed = null;
            foreach (WebEndpoint one in goal.File == null ? endpoints : WithCable(endpoints))
            {
                if (!one.IsSecure) continue;
                // A code proves the key that is shown, so that an older one does not count: its owner may have made new keys.
                PairingResult result = AskToPair(goal.File == null ? one.WithPin(null) : one);
                if (result == null) return false;
                goal.Pairing = result;
                if (result.Outcome == PairingOutcome.Paired)
                {
                    goal.Code = "";
                    goal.PairsFirst = false;
                    KeepKey(one, endpoints, result.Endpoint.Pin);
                    return true;
                }
                if (failed == null || !IsFinal(result)) failed = result;
                if (result.Outcome != PairingOutcome.NotReached && result.Outcome != PairingOutcome.NoAnswer) break;
            }
            if (failed == null || (endpoints.Exists(one => one.Pin != null) && goal.ForgetUsedCode(failed))) return true; // without TLS there is nothing to pair
            goal.Pairing = failed;
            Phrase phrase = ConnectorWords.OfPairing(failed, goal.File, (DateTime.UtcNow - DateTime.UnixEpoch).TotalSeconds);
            if (IsFinal(failed)) Fail(phrase, failed.End, failed.Refusal);
            else TryAgain(phrase, failed.End);
            return false;
        }

        private PairingResult AskToPair(WebEndpoint endpoint)
        {
            Publish(new ConnectorView(ConnectorPhase.Pairing, FindObstacle(), endpoint.ToString(), goal.Session, pairing: goal.Pairing));
            PairingClient pairing = new PairingClient(endpoint, goal.Code, settings.Identity.KeyHash, Words.ToLine(settings.Name, MaxName), Words.ToLine(settings.Software, MaxName));
            pairing.Start();
            bool isDone = WaitFor(() => pairing.Result != null);
            pairing.Stop();
            return isDone ? pairing.Result : null;
        }

        /// <summary>Return whether the same code would fail in the same way in a moment.</summary>
        private static bool IsFinal(PairingResult result)
        {
            if (result.Outcome == PairingOutcome.Refused) return result.Refusal.Code != RefusalCode.Rate;
            return result.Outcome != PairingOutcome.NoAnswer && (result.Outcome != PairingOutcome.NotReached || !IsPassing(result.End));
        }

        /// <summary>See which key the session has. One that no session was known by is shown to the person, and nothing is sent.</summary>
        private bool CompareKey(List<WebEndpoint> endpoints)
        {
            LinkEnd end = default;
            foreach (WebEndpoint one in endpoints)
            {
                Search(one.ToString());
                GatewayProbe probe = new GatewayProbe(one, null);
                probe.Start();
                bool isDone = WaitFor(() => probe.HasEnded);
                probe.Abort();
                if (!isDone) return false;
                end = probe.Answer.End;
                if (end.Failure != LinkFailure.UnknownCertificate) continue;
                if (settings.Identity.IsKnownPin(end.CertificateHash))
                {
                    KeepKey(one, endpoints, end.CertificateHash);
                    return true;
                }
                shown = end;
                shownBy = endpoints;
                Publish(new ConnectorView(ConnectorPhase.Untrusted, LinkWords.OfEnd(end), one.ToString(), goal.Session, problem: end));
                WaitForOrder();
                return false;
            }
            TryAgain(end);
            return false;
        }

        /// <summary>Accept the key that was shown, if it is the one that the person has compared.</summary>
        private void TrustShown(string compared)
        {
            if (compared.Length > 0 && compared == shown.Fingerprint) KeepKey(shownBy[0], shownBy, shown.CertificateHash);
            shown = default;
        }

        /// <summary>Keep the key of a session for all its addresses, and for the one that showed it.</summary>
        private void KeepKey(WebEndpoint by, List<WebEndpoint> endpoints, byte[] pin)
        {
            settings.Identity.KeepPin(by.Authority, pin);
            for (int i = 0; i < endpoints.Count; i++)
            {
                if (!endpoints[i].IsSecure) continue;
                endpoints[i] = endpoints[i].WithPin(pin);
                if (endpoints[i].Authority != by.Authority) settings.Identity.KeepPin(endpoints[i].Authority, pin);
            }
        }

        /// <summary>Return addresses with that of the cable before them, if it is wanted and the key is known that has to be shown there.</summary>
        private List<WebEndpoint> WithCable(List<WebEndpoint> endpoints)
        {
            List<WebEndpoint> all = new List<WebEndpoint>(endpoints);
            WebEndpoint known = settings.UsesCable ? all.Find(one => one.IsSecure && one.Pin != null) : null;
            if (known != null && !all.Exists(one => one.IsLoopback)) all.Insert(0, new WebEndpoint(true, "localhost", known.Port, known.Pin));
            return all;
        }

        // --- in the session ---------------------------------------------------------------------------------------------------------

        private void Join(List<WebEndpoint> endpoints)
        {
            if (!WaitFor(() => !isPaused)) return;
            WebEndpoint known = endpoints.Find(one => one.Pin != null);
            List<WebEndpoint> ways = WithCable(endpoints);
            if (known != null) for (int i = 0; i < ways.Count; i++) if (ways[i].IsSecure && ways[i].Pin == null) ways[i] = ways[i].WithPin(known.Pin); // one session, one key
            Search(ways[0].ToString());
            SessionClient client = new SessionClient(MakeHello(), settings.Identity, new EndpointChooser(ways.ToArray()), settings.MakeTransport());
            SceneFetcher scene = new SceneFetcher(client, settings.Cache, settings.Budget);
            SessionView end = null;
            try
            {
                client.Start();
                scene.Start();
                end = Follow(client, scene);
            }
            finally // also after a defect: no session goes on without an engine, which lets go of the client first
            {
                Publish(new ConnectorView(ConnectorPhase.Searching, ConnectorWords.None, end == null ? "" : newest.Endpoint, end == null ? "" : goal.Session));
                scene.Stop();
                bool isLost = client.View.Welcome != null && !client.View.IsJoined;
                client.Stop();
                if (isLost && client.UnsentStop != null)
                {
                    unsent = client.UnsentStop;
                    unsentFor = client.View.Welcome.SessionId;
                }
            }
            if (end == null) return;
            if (end.IsJoined) // another session, which was started at this address
            {
                Phrase phrase = ConnectorWords.OfOtherSession(end.Welcome.SessionName);
                if (goal.Chosen != null) TryAgain(phrase, default);
                else Fail(phrase);
                return;
            }
            bool isStranger = end.Problem.Failure == LinkFailure.WrongCertificate || (end.Failure != null && (end.Failure.Code == RefusalCode.Unpaired || end.Failure.Code == RefusalCode.Identity));
            if (isStranger && goal.Code.Length > 0) goal.PairsFirst = true;
            else Fail(end.Failure != null ? Words.OfRefusal(end.Failure) : LinkWords.OfEnd(end.Problem), end.Problem, end.Failure);
        }

        /// <summary>Return the hello of a new client. Its run is its own: what happens to the tracking frame between two clients is not known.</summary>
        private Hello MakeHello()
        {
            List<string> capabilities = new List<string>(settings.Capabilities);
            if (!capabilities.Exists(one => one.StartsWith(RunPrefix, StringComparison.Ordinal))) capabilities.Add(RunPrefix + Guid.NewGuid().ToString("N"));
            return new Hello { Role = settings.Role, Name = Words.ToLine(settings.Name, MaxName), Software = Words.ToLine(settings.Software, MaxName), Devices = settings.Devices, Capabilities = capabilities.ToArray() };
        }

        /// <summary>Say how a client fares until there is an order, or it was lost for long: null then; or until the session or its key ends it, or it is another session.</summary>
        private SessionView Follow(SessionClient client, SceneFetcher scene)
        {
            bool isRunning = false;
            WebEndpoint endpoint = null;
            string text = newest.Endpoint;
            long joinedNs = MonotonicClock.NowNs; // or begun
            while (Wait(isRunning ? SlowLookMs : LookMs))
            {
                SessionView now = client.View;
                if (now.Failure != null || now.Problem.Failure != LinkFailure.None) return now;
                if (now.IsJoined && settings.SessionName.Length > 0 && now.Welcome.SessionName != settings.SessionName) return now;
                isRunning |= now.IsJoined;
                long nowNs = MonotonicClock.NowNs;
                if (now.IsJoined || isPaused) joinedNs = nowNs;
                if (now.IsJoined && unsent != null && now.Welcome.SessionId == unsentFor)
                {
                    client.EStop(unsent.Reason);
                    unsent = null;
                }
                if (!now.IsJoined && isRunning && nowNs - joinedNs >= settings.LostNs)
                {
                    goal.Chosen = null; // of those that announce themselves now
                    return null;
                }
                if (now.Endpoint != null && now.Endpoint != endpoint) text = (endpoint = now.Endpoint).ToString();
                bool isSame = newest.Endpoint == text && newest.Phase == ConnectorPhase.Running;
                if (isRunning && !isSame) Publish(new ConnectorView(ConnectorPhase.Running, ConnectorWords.None, text, goal.Session, pairing: goal.Pairing, client: client, scene: scene));
                else if (!isRunning && nowNs - joinedNs >= JoinNs) Publish(new ConnectorView(ConnectorPhase.Searching, FindReason(client), text, goal.Session, pairing: goal.Pairing));
            }
            return null;
        }

        /// <summary>Return why a client has not joined yet.</summary>
        private static Phrase FindReason(SessionClient client)
        {
            Advice[] all = client.Advice;
            foreach (Advice one in all) if (one.Kind >= AdviceKind.Link && one.Kind <= AdviceKind.Joining) return one.Phrase;
            return ConnectorWords.None;
        }

        // --- what is said -----------------------------------------------------------------------------------------------------------

        private void Search(string where)
        {
            Publish(new ConnectorView(ConnectorPhase.Searching, FindObstacle(), where, goal.Session, pairing: goal.Pairing));
        }

        /// <summary>Return what was in the way of the attempt before this one: it is said until one gets further.</summary>
        private Phrase FindObstacle()
        {
            return newest.Phase == ConnectorPhase.Searching || newest.Phase == ConnectorPhase.Pairing ? newest.Phrase : ConnectorWords.None;
        }

        private void TryAgain(LinkEnd end)
        {
            if (IsPassing(end)) TryAgain(LinkWords.OfEnd(end), end);
            else Fail(LinkWords.OfEnd(end), end);
        }

        /// <summary>Say why it does not go on, and begin again after a pause.</summary>
        private void TryAgain(Phrase phrase, LinkEnd end)
        {
            Publish(new ConnectorView(ConnectorPhase.Searching, phrase, newest.Endpoint, goal.Session, pairing: goal.Pairing, problem: end));
            goal.Chosen = null; // it may announce itself elsewhere
            Wait(settings.AgainMs);
        }

        /// <summary>Say why it does not go on, and wait for an order.</summary>
        private void Fail(Phrase phrase, LinkEnd problem = default, Refused refusal = null)
        {
            newest = new ConnectorView(ConnectorPhase.Failed, phrase, newest.Endpoint, goal.Session, pairing: goal.Pairing, refusal: refusal, problem: problem); // also the same: it answers
            WaitForOrder();
        }

        /// <summary>Return whether a link may be there in a moment.</summary>
        private static bool IsPassing(LinkEnd end)
        {
            return end.Failure == LinkFailure.Unreachable || end.Failure == LinkFailure.None || (end.Failure == LinkFailure.Closed && end.Code != CloseCode.Version && end.Code != CloseCode.NotAllowed);
        }

        private void Publish(ConnectorView view)
        {
            if (!view.IsSame(newest)) newest = view;
        }
    }
}
