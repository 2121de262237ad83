// Words for what a session reports: what is wrong, and what to do. The cases are those of web_client/src/ui/words.ts; a test checks
// that every reason of the protocol has words.
using System.Collections.Generic;
using System.Globalization;
using System.Text;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>What is wrong, and what a person does about it. Either may be empty.</summary>
    public readonly struct Phrase
    {
        public readonly string What;
        public readonly string Remedy;

        public Phrase(string what, string remedy)
        {
            What = what;
            Remedy = remedy;
        }

        /// <summary>Both as sentences.</summary>
        public override string ToString()
        {
            return Remedy.Length == 0 ? Words.ToSentence(What) : Words.ToSentence(What) + " " + Words.ToSentence(Remedy);
        }
    }

    /// <summary>Tables of words.</summary>
    public static class Words
    {
        private const string Reclutch = "open and close the clutch";

        private static readonly Dictionary<string, Phrase> Holds = new Dictionary<string, Phrase>
        {
            [HoldReason.NoLease] = new Phrase("the robot is free", "point at it and press the trigger"),
            [HoldReason.NoSample] = new Phrase("its holder sends nothing yet", ""),
            [HoldReason.ClutchOpen] = new Phrase("the clutch is open", "squeeze to move the robot"),
            [HoldReason.Stale] = new Phrase("samples come too late or not at all", "come nearer to the access point"),
            [HoldReason.NotWorn] = new Phrase("the headset was taken off", "put it on, then " + Reclutch),
            [HoldReason.Untracked] = new Phrase("tracking is lost", "bring the hand or controller into view"),
            [HoldReason.Unaligned] = new Phrase("the headset is not aligned", "look at a sheet"),
            [HoldReason.Rejected] = new Phrase("a sample was rejected", Reclutch),
            [HoldReason.Estop] = new Phrase("all robots are stopped by the e-stop", "a director clears it when everything is safe"),
            [HoldReason.Disconnected] = new Phrase("its holder is disconnected", ""),
            [HoldReason.Gap] = new Phrase("the session stood still", Reclutch),
            [HoldReason.SceneChanged] = new Phrase("the scene changed", Reclutch),
            [HoldReason.Intervention] = new Phrase("a person took over", ""),
            [HoldReason.Rearm] = new Phrase("the robot was let go", Reclutch),
            [HoldReason.ViewOnly] = new Phrase("the alignment is good enough to look, not to drive", "look at a sheet"),
            [HoldReason.Emulated] = new Phrase("the hand is out of sight, its position is a guess", "bring it into view, then " + Reclutch),
            [HoldReason.ZeroPose] = new Phrase("the device has no pose yet", "wait until it is tracked, then " + Reclutch),
            [HoldReason.Frozen] = new Phrase("the pose of the device is frozen", "move or wake it, then " + Reclutch),
            [HoldReason.Jump] = new Phrase("tracking jumped", Reclutch),
            [HoldReason.Episode] = new Phrase("an episode is closing", Reclutch),
            [HoldReason.Unconfirmed] = new Phrase("the alignment is doubted", "glance at a sheet, then " + Reclutch),
        };

        private static readonly Dictionary<string, Phrase> Denials = new Dictionary<string, Phrase>
        {
            [DenialReason.Held] = new Phrase("another participant has it", "wait until it is free, or ask its holder"),
            [DenialReason.ConsentPending] = new Phrase("its holder has been asked", "wait for the answer"),
            [DenialReason.ConsentRefused] = new Phrase("its holder refused", "ask again later"),
            [DenialReason.Role] = new Phrase("your role may not do this", "ask a director for another role"),
            [DenialReason.UnknownTarget] = new Phrase("the session has no such robot or object", "choose another one"),
            [DenialReason.UnknownParticipant] = new Phrase("this participant is not in the session", ""),
            [DenialReason.UnknownRequest] = new Phrase("the session does not know this request", "update the older of app and session"),
            [DenialReason.UnknownValue] = new Phrase("the session does not know this value", "update the older of app and session"),
            [DenialReason.LeaseVersion] = new Phrase("the lease has changed meanwhile", "try again"),
            [DenialReason.NotHolder] = new Phrase("you do not hold it", "take it first"),
            [DenialReason.NotJoined] = new Phrase("this headset has not joined", "wait until it is connected"),
            [DenialReason.AlreadyJoined] = new Phrase("this headset has joined already", ""),
            [DenialReason.Estop] = new Phrase("all robots are stopped by the e-stop", "a director clears it when everything is safe"),
            [DenialReason.Unaligned] = new Phrase("the headset is not aligned", "look at a sheet"),
            [DenialReason.AlignmentRefused] = new Phrase("the alignment was refused", "look at the sheet again, from nearer"),
            [DenialReason.EpisodeState] = new Phrase("the episode is not in a state for this", "start or end the episode first"),
            [DenialReason.QueueFull] = new Phrase("too many wait for it", "try again later"),
            [DenialReason.Quota] = new Phrase("too many requests at once", "wait a second"),
            [DenialReason.SessionFull] = new Phrase("the session is full", "wait until a participant leaves"),
            [DenialReason.UserOwned] = new Phrase("the program of the session decides this", "ask its owner"),
            [DenialReason.Policy] = new Phrase("robots are assigned by the session", "ask a director"),
            [DenialReason.Invalid] = new Phrase("a value is out of range", "choose another one"),
            [DenialReason.Withdrawn] = new Phrase("the request was taken back", ""),
            [DenialReason.TooFar] = new Phrase("it is farther away than is likely", "confirm it if it is meant"),
            [DenialReason.ViewOnly] = new Phrase("the alignment is good enough to look, not to drive", "look at a sheet"),
        };

        private static readonly Dictionary<string, Phrase> Refusals = new Dictionary<string, Phrase>
        {
            [RefusalCode.Version] = new Phrase("the session speaks another version of the protocol", "update the older of app and session"),
            [RefusalCode.Identity] = new Phrase("the session does not accept this headset's identity", "pair it again"),
            [RefusalCode.Malformed] = new Phrase("the session could not read what this app said", "update the older of app and session"),
            [RefusalCode.TooLarge] = new Phrase("this app said too much at once", "update the older of app and session"),
            [RefusalCode.Rate] = new Phrase("too many join at once", "it tries again by itself"),
            [RefusalCode.GatewayOnly] = new Phrase("this way in is for gateways", "use the address of the page"),
            [RefusalCode.ResumeToken] = new Phrase("the session does not know the earlier connection", "it joins anew by itself"),
            [RefusalCode.Full] = new Phrase("the session is full", "wait until a participant leaves"),
            [RefusalCode.Unpaired] = new Phrase("this headset is not paired", "on the computer of the session run iris-session pair, and scan the code"),
            [RefusalCode.Code] = new Phrase("the join code is wrong, used or expired", "make a new one with iris-session pair"),
            [DenialReason.SessionFull] = new Phrase("the session is full", "wait until a participant leaves"),
            [DenialReason.Role] = new Phrase("this headset may not join in this role", "choose another role, or ask the owner of the session"),
            [FaultCode.Revoked] = new Phrase("this headset was taken off the list", "ask the owner of the session"),
            [ClientConnection.Replaced] = new Phrase("another device took over with this identity", "give every headset an identity of its own"),
        };

        private static readonly Dictionary<string, Phrase> Faults = new Dictionary<string, Phrase>
        {
            [FaultCode.Version] = new Phrase("the session speaks another version of the protocol", "update the older of app and session"),
            [FaultCode.Malformed] = new Phrase("the session could not read a message of this app", "update the older of app and session"),
            [FaultCode.TooLarge] = new Phrase("a message of this app was too large", "update the older of app and session"),
            [FaultCode.Rate] = new Phrase("this app sends too much", "it goes on with less by itself"),
            [FaultCode.Hello] = new Phrase("the session was restarted", "it joins again by itself"),
            [FaultCode.Dropped] = new Phrase("the session closed this connection", "it joins again by itself"),
            [FaultCode.Stalled] = new Phrase("the simulation stands still: robots hold", "wait, or ask the owner of the session"),
            [FaultCode.Recovered] = new Phrase("the simulation goes on", ""),
            [FaultCode.SessionEnded] = new Phrase("the session has ended", "it joins the next one by itself"),
            [FaultCode.Revoked] = new Phrase("this headset was taken off the list", "ask the owner of the session"),
        };

        private static readonly Dictionary<string, Phrase> Assets = new Dictionary<string, Phrase>
        {
            [AssetRefusal.Unknown] = new Phrase("the session does not have a part of the scene", "load the scene again"),
            [AssetRefusal.BadRange] = new Phrase("a part of the scene has another length than stated", "load the scene again"),
            [AssetRefusal.Version] = new Phrase("the session speaks another version of the protocol", "update the older of app and session"),
            [AssetRefusal.Malformed] = new Phrase("the session could not read a request of this app", "update the older of app and session"),
            [AssetRefusal.TooMany] = new Phrase("too much of the scene is requested at once", "it goes on by itself"),
            [AssetRefusal.Rate] = new Phrase("too much of the scene is requested in a short time", "it goes on by itself"),
            [AssetRefusal.Busy] = new Phrase("the session has no time for the scene now", "it goes on by itself"),
            [AssetRefusal.NotAllowed] = new Phrase("this headset may not fetch the scene", "pair it again"),
        };

        private static readonly Dictionary<string, Phrase> Streams = new Dictionary<string, Phrase>
        {
            [StreamFault.Frozen] = new Phrase("its camera repeats one frame", "plug it in again"),
            [StreamFault.NoDepth] = new Phrase("its camera measures no depth", "check what covers it"),
            [StreamFault.Saturated] = new Phrase("its depth is saturated", "move it away, or shade it"),
            [StreamFault.Size] = new Phrase("its frames have another size than configured", "check its configuration"),
            [StreamFault.Moved] = new Phrase("its camera was moved", "calibrate it again"),
            [StreamFault.Pose] = new Phrase("the pose of its camera is not valid", "calibrate it again"),
            [StreamFault.Clock] = new Phrase("its clock jumps", "set the clocks of the computers"),
            [StreamFault.Slow] = new Phrase("its source is too slow", ""),
            [StreamFault.Source] = new Phrase("its source fails", "look at its log"),
        };

        /// <summary>Why a robot holds: a `HoldReason`.</summary>
        public static Phrase OfHold(string reason) { return Find(Holds, reason); }

        /// <summary>Why a request was denied. The session's own words come first, and name the holder.</summary>
        public static Phrase OfDenial(Denial denial)
        {
            Phrase known = Find(Denials, denial.Reason);
            string what = denial.Message.Length > 0 ? denial.Message : known.What;
            if (denial.HolderName.Length > 0 && what.IndexOf(denial.HolderName, System.StringComparison.Ordinal) < 0) what += " (held by " + denial.HolderName + ")";
            return new Phrase(what, denial.Advice.Length > 0 ? denial.Advice : known.Remedy);
        }

        /// <summary>Why this headset may not join.</summary>
        public static Phrase OfRefusal(Refused refused)
        {
            Phrase known = Find(Refusals, refused.Code);
            if (refused.Code == RefusalCode.Version && refused.SupportedVersions.Length > 0)
            {
                string versions = string.Join(", ", System.Array.ConvertAll(refused.SupportedVersions, one => one.ToString(CultureInfo.InvariantCulture)));
                return new Phrase("the session speaks version " + versions + " of the protocol, this app version " + Wire.Version, known.Remedy);
            }
            return new Phrase(refused.Message.Length > 0 ? refused.Message : known.What, refused.Advice.Length > 0 ? refused.Advice : known.Remedy);
        }

        /// <summary>What a fault means: a `FaultCode`.</summary>
        public static Phrase OfFault(string code) { return Find(Faults, code); }

        /// <summary>Why an asset is refused: an `AssetRefusal`.</summary>
        public static Phrase OfAsset(string reason) { return Find(Assets, reason); }

        /// <summary>What is wrong with a media stream: a `StreamFault`.</summary>
        public static Phrase OfStream(string fault) { return Find(Streams, fault); }

        /// <summary>Return a text of others on one line, cut to so many characters.</summary>
        public static string ToLine(string text, int most = 160)
        {
            StringBuilder line = new StringBuilder();
            foreach (char c in text)
            {
                if (line.Length == most)
                {
                    line.Append("...");
                    break;
                }
                line.Append(char.IsControl(c) || c == '\u2028' || c == '\u2029' ? ' ' : c);
            }
            return line.ToString();
        }

        /// <summary>Return a length such as `7.5 mm`, `12 cm`, `1.4 m`.</summary>
        public static string FormatLength(double metres)
        {
            double mm = 1000.0 * metres;
            if (mm < 100.0) return mm.ToString(mm < 10.0 ? "F1" : "F0", CultureInfo.InvariantCulture) + " mm";
            return metres < 1.0 ? (100.0 * metres).ToString("F0", CultureInfo.InvariantCulture) + " cm" : metres.ToString("F1", CultureInfo.InvariantCulture) + " m";
        }

        /// <summary>Return a duration such as `0.4 s`, `3 s`, `4 min`, `2 h`.</summary>
        public static string FormatAge(long ns)
        {
            double s = System.Math.Max(0.0, 1e-9 * ns);
            if (s < 90.0) return s.ToString(s < 2.0 ? "F1" : "F0", CultureInfo.InvariantCulture) + " s";
            return s < 5400.0 ? (s / 60.0).ToString("F0", CultureInfo.InvariantCulture) + " min" : (s / 3600.0).ToString("F1", CultureInfo.InvariantCulture) + " h";
        }

        /// <summary>Return a text with a capital and a full stop.</summary>
        internal static string ToSentence(string text)
        {
            if (text.Length == 0) return "";
            string sentence = char.ToUpperInvariant(text[0]) + text.Substring(1);
            return ".!?:".IndexOf(text[text.Length - 1]) >= 0 ? sentence : sentence + ".";
        }

        /// <summary>True for a phrase that a table has.</summary>
        internal static bool IsKnown(Phrase phrase, string reason) { return phrase.What != reason.Replace('_', ' '); }

        private static Phrase Find(Dictionary<string, Phrase> table, string reason)
        {
            return table.TryGetValue(reason, out Phrase known) ? known : new Phrase(reason.Replace('_', ' '), "");
        }
    }
}
