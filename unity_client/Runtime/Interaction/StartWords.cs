// Lines of the panel before there is a session.
using System.Collections.Generic;
using System.Text;
using IrisSession.Core;
using IrisSession.Transport;

namespace IrisSession.Interaction
{
    /// <summary>Makes the text of <see cref="StartPanel"/>.</summary>
    public static class StartWords
    {
        /// <summary>Pairs of digits in a line of a fingerprint.</summary>
        private const int PairsOfLine = 8;

        /// <summary>Return what a connector does, what is wrong and what to do.</summary>
        /// <param name="view">The connector.</param>
        /// <param name="isDeclined">The wearer has said that the key is another one.</param>
        /// <param name="readsCodes">This headset reads codes.</param>
        public static IEnumerable<string> Describe(ConnectorView view, bool isDeclined, bool readsCodes)
        {
            if (isDeclined)
            {
                yield return "This session was not joined: its key is not the one that iris-session pair shows.";
                yield return "Another computer may pretend to be the session. Ask its owner.";
                yield break;
            }
            string where = view.Endpoint.Length > 0 ? " " + view.Endpoint : "";
            if (view.Phase == ConnectorPhase.Searching && view.Phrase.What.Length == 0) yield return where.Length > 0 ? "Joining" + where + "." : "Looking for a session in this network.";
            if (view.Phase == ConnectorPhase.Pairing) yield return "Pairing with" + (where.Length > 0 ? where : " the session") + ".";
            if (view.Phase == ConnectorPhase.Untrusted) yield return "The key of" + (where.Length > 0 ? where : " this session") + " is not known here. Compare its certificate with that of iris-session pair:";
            else if (view.Phrase.What.Length > 0) yield return view.Phrase.ToString();
            if (view.Phase == ConnectorPhase.Choosing) yield return "Point at yours and press the trigger.";
            if (readsCodes && MayScan(view)) yield return "Or look at the code that iris-session pair shows.";
        }

        /// <summary>Return the button of a link that was seen.</summary>
        public static string Describe(PairingLink invitation)
        {
            return "Join " + (invitation.SessionName.Length > 0 ? Words.ToLine(invitation.SessionName, 24) + " at " : "") + Words.ToLine(invitation.Host, 40);
        }

        /// <summary>Return whether a link can be scanned now: not while one is entered, and nothing is wrong with it.</summary>
        public static bool MayScan(ConnectorView view)
        {
            if (view.Phase == ConnectorPhase.Searching) return view.Endpoint.Length == 0 || view.Phrase.What.Length > 0;
            return view.Phase == ConnectorPhase.Choosing || view.Phase == ConnectorPhase.Untrusted || view.Phase == ConnectorPhase.Failed;
        }

        /// <summary>Return the button of a session.</summary>
        public static string Describe(OfferedSession session)
        {
            return Words.ToLine(session.Name, 24) + " at " + session.Host + (session.IsKnown ? "" : " (new)");
        }

        /// <summary>Return a fingerprint in lines that can be compared.</summary>
        public static string FormatFingerprint(string fingerprint)
        {
            StringBuilder lines = new StringBuilder();
            string[] pairs = fingerprint.Split(':');
            for (int i = 0; i < pairs.Length; i++) lines.Append(i == 0 ? "" : i % PairsOfLine == 0 ? "\n" : ":").Append(pairs[i]);
            return lines.ToString();
        }
    }
}
