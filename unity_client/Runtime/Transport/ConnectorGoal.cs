using System;
using System.Collections.Generic;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>What a connector was given to reach a session. For its thread.</summary>
    internal sealed class ConnectorGoal
    {
        /// <summary>The pairing file, null for none; and links, none for sessions that announce themselves.</summary>
        public readonly PairingFile File;
        public readonly List<PairingLink> Links = new List<PairingLink>();

        /// <summary>Why what was given cannot be used, empty when it can.</summary>
        public readonly Phrase Fault = new Phrase("", "");

        /// <summary>Of those that announce themselves: the one that the person or the connector took, null before.</summary>
        public OfferedSession Chosen;

        /// <summary>Join code that was not used yet, empty for none.</summary>
        public string Code = "";

        /// <summary>Pair even where the key is known: the person just gave the code, or the session does not know this headset.</summary>
        public bool PairsFirst;

        /// <summary>The code is that of a link which was entered: this headset may have used it already.</summary>
        public bool MayBeUsed;

        /// <summary>What became of the newest pairing, null for none.</summary>
        public PairingResult Pairing;

        /// <param name="pairingFile">Text of a pairing file, null for none.</param>
        /// <param name="address">Address, link or several with commas; empty for none.</param>
        public ConnectorGoal(string pairingFile, string address)
        {
            try
            {
                if (pairingFile != null)
                {
                    File = PairingFile.Parse(pairingFile);
                    Code = File.Code;
                    return;
                }
                if (string.IsNullOrWhiteSpace(address)) return;
                foreach (string one in address.Split(',')) Links.Add(PairingLink.Parse(one));
                foreach (PairingLink link in Links) if (link.Code.Length > 0) Code = link.Code;
            }
            catch (ClientException error)
            {
                Fault = new Phrase(error.Message, "");
            }
        }

        /// <summary>Name of the session, empty while it is not known.</summary>
        public string Session { get { return File != null ? File.Session : Chosen != null ? Chosen.Name : Links.Count > 0 ? Links[0].SessionName : ""; } }

        /// <summary>Forget the code of a link that was seen once more. Returns whether it did: a key that is known is enough then.</summary>
        public bool ForgetUsedCode(PairingResult failed)
        {
            if (!MayBeUsed || failed.Outcome != PairingOutcome.Refused || failed.Refusal.Code != Protocol.RefusalCode.Code) return false;
            Code = "";
            PairsFirst = MayBeUsed = false;
            return true;
        }

        /// <summary>Return the endpoints of the pairing file, with its key, best first.</summary>
        public List<WebEndpoint> ListFileEndpoints()
        {
            List<WebEndpoint> endpoints = new List<WebEndpoint>();
            foreach (string address in File.Addresses)
            {
                WebEndpoint endpoint = WebEndpoint.Parse(address);
                if (endpoint != null && endpoint.IsSecure) endpoints.Add(endpoint.WithPin(File.Pin));
            }
            return endpoints;
        }
    }

    /// <summary>Words of a connector, of what is no end of a connection.</summary>
    internal static class ConnectorWords
    {
        public const string GiveAddress = "type its address, or scan the code that `iris-session pair` shows";
        private const string NewFile = "make a new one with iris-session pair --unity, and copy it to this headset";

        public static readonly Phrase None = new Phrase("", "");
        public static readonly Phrase SeveralSessions = new Phrase("several sessions are heard", "choose one");
        public static readonly Phrase Defect = new Phrase("a defect of this app is in the way of a session", "start the app again");

        /// <summary>Why no session is heard that can be joined.</summary>
        /// <param name="listener">Which listens.</param>
        /// <param name="wanted">Name of the session, empty for any.</param>
        /// <param name="others">Sessions that are heard and cannot be joined, or have another name.</param>
        public static Phrase OfSilence(BeaconListener listener, string wanted, List<string> others)
        {
            if (listener.Problem.Length > 0) return new Phrase("announcements of sessions cannot be heard: " + Words.ToLine(listener.Problem), GiveAddress);
            if (others.Count > 0 && wanted.Length > 0) return new Phrase("no session \"" + Words.ToLine(wanted) + "\" is heard, but: " + Words.ToLine(string.Join(", ", others)), "correct the name, or " + GiveAddress);
            if (others.Count > 0) return new Phrase("no session that is heard has a web gateway: " + Words.ToLine(string.Join(", ", others)), "start it without --no-web");
            if (listener.OtherVersions > 0) return new Phrase("the session that is heard speaks another version of the protocol", "update the older of app and session");
            return new Phrase("no session is heard in this network", "start one here, or " + GiveAddress);
        }

        /// <summary>A session answers where one of another name is wanted.</summary>
        public static Phrase OfOtherSession(string name)
        {
            return new Phrase("another session is there now: \"" + Words.ToLine(name) + "\"", "correct the name, or " + GiveAddress);
        }

        /// <summary>What became of a pairing by a file or a code.</summary>
        /// <param name="result">Not `Paired`.</param>
        /// <param name="file">From which the code is, null for none.</param>
        /// <param name="nowS">[s, UTC].</param>
        public static Phrase OfPairing(PairingResult result, PairingFile file, double nowS)
        {
            if (file == null) return LinkWords.OfPairing(result);
            if (result.Outcome == PairingOutcome.Refused && result.Refusal.Code == Protocol.RefusalCode.Code)
            {
                return new Phrase("the code of the pairing file " + (file.HasExpired(nowS) ? "has expired" : "is used or expired"), NewFile);
            }
            return result.End.Failure == LinkFailure.WrongCertificate ? new Phrase("the session has another key than its pairing file says", NewFile) : LinkWords.OfPairing(result);
        }
    }
}
