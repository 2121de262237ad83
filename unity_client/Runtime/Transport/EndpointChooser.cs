// Which of several addresses of a session is used: the first that answers, in the order of preference, the cable before Wi-Fi. Pure.
//
// After a loss all are tried again from the first one on. While a later one is in use, those before it are probed; when one answers,
// the connection moves to it, and the session is resumed by its token. An address whose certificate is not the known one is left out
// until the person has decided.
using System;
using System.Collections.Generic;

namespace IrisSession.Transport
{
    /// <summary>The addresses of one session.</summary>
    public sealed class EndpointChooser
    {
        /// <summary>Period of probes, and the pause before an address is probed that answered a probe and then did not let us join.</summary>
        private const long ProbeNs = 2_000_000_000;
        private const long HoldNs = 30_000_000_000;

        private sealed class Candidate
        {
            public WebEndpoint Endpoint;
            public LinkEnd Blocked; // of its certificate, or none
            public long ProbeAt;
            public bool IsMovedTo; // its probe was answered, and no welcome came yet
        }

        private readonly List<Candidate> candidates = new List<Candidate>();
        private int at = -1;
        private int probing = -1;

        /// <param name="endpoints">In the order of preference.</param>
        public EndpointChooser(params WebEndpoint[] endpoints)
        {
            foreach (WebEndpoint endpoint in endpoints) candidates.Add(new Candidate { Endpoint = endpoint });
        }

        /// <summary>Address in use or tried now, null for none.</summary>
        public WebEndpoint Current { get { return at < 0 ? null : candidates[at].Endpoint; } }

        /// <summary>Certificate of the first address that shows another key than the known one, none without.</summary>
        public LinkEnd Blocked
        {
            get
            {
                foreach (Candidate each in candidates) if (each.Blocked.Failure != LinkFailure.None) return each.Blocked;
                return default;
            }
        }

        /// <summary>Moves to a better address.</summary>
        public long Moves { get; private set; }

        /// <summary>Add an address at the end, or before the others; one that is known stays where it is, with the newest key.</summary>
        public void Add(WebEndpoint endpoint, bool isPreferred = false)
        {
            foreach (Candidate each in candidates)
            {
                if (each.Endpoint.ToString() != endpoint.ToString()) continue;
                if (endpoint.Pin == null || CertificateHash.AreEqual(each.Endpoint.Pin, endpoint.Pin)) return;
                each.Endpoint = endpoint; // paired anew
                each.Blocked = default;
                return;
            }
            candidates.Insert(isPreferred ? 0 : candidates.Count, new Candidate { Endpoint = endpoint });
            if (!isPreferred) return;
            if (at >= 0) at++;
            if (probing >= 0) probing++;
        }

        /// <summary>Return the address for a fresh socket, null when none may be used.</summary>
        public WebEndpoint Choose()
        {
            for (int i = 0; i < candidates.Count; i++)
            {
                int index = (Math.Max(at, 0) + i) % candidates.Count;
                if (candidates[index].Blocked.Failure != LinkFailure.None) continue;
                at = index;
                return Current;
            }
            return null;
        }

        /// <summary>The socket of the current address did not lead to a welcome.</summary>
        public void OnFailed(LinkEnd end, long nowNs)
        {
            if (at < 0) return;
            if (end.Failure == LinkFailure.UnknownCertificate || end.Failure == LinkFailure.WrongCertificate) candidates[at].Blocked = end;
            candidates[at].ProbeAt = nowNs + (candidates[at].IsMovedTo ? HoldNs : ProbeNs);
            candidates[at].IsMovedTo = false;
            at = (at + 1) % candidates.Count;
        }

        /// <summary>The session has welcomed us at the current address.</summary>
        public void OnJoined()
        {
            if (at >= 0) candidates[at].IsMovedTo = false;
        }

        /// <summary>A connection that was joined is lost: begin with the first address again.</summary>
        public void OnLost()
        {
            at = candidates.Count == 0 ? -1 : 0;
        }

        /// <summary>Accept the key that addresses have shown. Returns whether one of them has it.</summary>
        public bool Trust(byte[] certificateHash)
        {
            bool isFound = false;
            foreach (Candidate each in candidates)
            {
                if (!CertificateHash.AreEqual(each.Blocked.CertificateHash, certificateHash)) continue;
                each.Endpoint = each.Endpoint.WithPin(certificateHash);
                each.Blocked = default;
                isFound = true;
            }
            return isFound;
        }

        /// <summary>Return a better address to probe now, null for none.</summary>
        public WebEndpoint TakeProbe(long nowNs)
        {
            if (probing >= 0) return null;
            for (int i = 0; i < at; i++)
            {
                if (candidates[i].Blocked.Failure != LinkFailure.None || nowNs < candidates[i].ProbeAt) continue;
                probing = i;
                return candidates[i].Endpoint;
            }
            return null;
        }

        /// <summary>Return the time of the next probe; `long.MaxValue` for none.</summary>
        public long NextProbeNs
        {
            get
            {
                long next = long.MaxValue;
                if (probing >= 0) return next;
                for (int i = 0; i < at; i++) if (candidates[i].Blocked.Failure == LinkFailure.None) next = Math.Min(next, candidates[i].ProbeAt);
                return next;
            }
        }

        /// <summary>Process the answer to a probe. Returns whether the connection is to be moved there.</summary>
        /// <param name="answer">Of the address that <see cref="TakeProbe"/> returned.</param>
        /// <param name="sessionId">The session that we are in; empty: nothing moves now, as we are in none, or a robot follows.</param>
        /// <param name="nowNs">A monotonic clock.</param>
        public bool OnProbe(ProbeAnswer answer, string sessionId, long nowNs)
        {
            int probed = probing;
            probing = -1;
            if (probed < 0 || probed >= at) return false; // the connection has moved meanwhile
            candidates[probed].ProbeAt = nowNs + ProbeNs;
            LinkFailure failure = answer.End.Failure;
            if (failure == LinkFailure.UnknownCertificate || failure == LinkFailure.WrongCertificate) candidates[probed].Blocked = answer.End;
            if (failure != LinkFailure.None || sessionId.Length == 0 || answer.SessionId != sessionId) return false;
            at = probed;
            candidates[at].IsMovedTo = true;
            Moves++;
            return true;
        }
    }
}
