using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Words for ends of connections and for pairings: what is wrong, and what a person does about it.</summary>
    public static class LinkWords
    {
        private const string ByItself = "it joins again by itself";
        private const string Update = "update the older of app and session";

        /// <summary>Return why a connection is not there; empty for none.</summary>
        public static Phrase OfEnd(LinkEnd end)
        {
            string text = Words.ToLine(end.Text ?? "");
            switch (end.Failure)
            {
                case LinkFailure.None: return new Phrase("", "");
                case LinkFailure.Unreachable: return new Phrase(Or(text, "the session does not answer"), "is the session running, and is this headset in its network?");
                case LinkFailure.Closed: return OfCode(end.Code, text);
                case LinkFailure.UnknownCertificate:
                    return new Phrase(Or(text, "the key of this session is not known yet") + ": " + end.Fingerprint, "compare it with the certificate that `iris-session pair` shows, or scan its code");
                case LinkFailure.WrongCertificate:
                    return new Phrase(Or(text, "the session has another key than before") + ": " + end.Fingerprint, "another machine may pretend to be it: pair again only if its owner has made new keys");
                case LinkFailure.NotAGateway: return new Phrase(Or(text, "this is not the page of a session"), "check the address: `iris-session pair --web` shows it");
                case LinkFailure.Protocol: return new Phrase(Or(text, "the session sends what this app does not understand"), Update);
                case LinkFailure.Defect: return new Phrase(Or(text, "a defect of this app has ended the session"), "start the app again");
                case LinkFailure.Overflow: return new Phrase("more came than this app could read", ByItself);
                default: return new Phrase(Or(text, "the connection has ended"), ByItself);
            }
        }

        /// <summary>Return what became of a pairing.</summary>
        public static Phrase OfPairing(PairingResult result)
        {
            switch (result.Outcome)
            {
                case PairingOutcome.Paired: return new Phrase("this headset is paired", "");
                case PairingOutcome.Refused: return Words.OfRefusal(result.Refusal);
                case PairingOutcome.NotProved: return new Phrase("the session did not prove that it knows the code: another machine may pretend to be it", "check the address, and make a new code");
                case PairingOutcome.NotReached: return OfEnd(result.End);
                case PairingOutcome.NoAnswer: return new Phrase("the session did not answer in time", "try the same code again");
                case PairingOutcome.NoCode: return new Phrase("this is not a join code", "type twelve letters and digits, like 7KQ2-M4XD-9PTR");
                default: return new Phrase("pairing was stopped", "");
            }
        }

        private static Phrase OfCode(int code, string text)
        {
            switch (code)
            {
                case CloseCode.SessionEnded: return new Phrase("the session has ended", "it joins the next one by itself");
                case CloseCode.Version: return new Phrase("the session speaks another version of the protocol", Update);
                case CloseCode.NotAllowed: return new Phrase(Or(text, "the session does not allow what this app did"), Update);
                case CloseCode.TooSlow: return new Phrase("this headset reads too slowly", "come nearer to the access point; " + ByItself);
                case CloseCode.Flood: return new Phrase("this app sent too much at once", ByItself);
                case CloseCode.Restart: return new Phrase("the session is restarted", ByItself);
                default: return new Phrase(Or(text, "the session closed the connection"), ByItself);
            }
        }

        private static string Or(string text, string fallback) { return text.Length > 0 ? text : fallback; }
    }
}
