// Events as sentences, for people. The cases are those of web_client/src/ui/words.ts.
using System;
using System.Collections.Generic;
using System.Globalization;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>How much attention an event needs.</summary>
    public enum EventLevel
    {
        Info,
        Warning,
        Error,
    }

    /// <summary>An event as a sentence.</summary>
    public readonly struct EventSentence
    {
        public readonly EventLevel Level;

        /// <summary>Empty for an event that people need not read, and for one of a later version.</summary>
        public readonly string Text;

        internal EventSentence(EventLevel level, string text)
        {
            Level = level;
            Text = text;
        }
    }

    /// <summary>Makes sentences of events.</summary>
    public static class EventWords
    {
        private static readonly Dictionary<string, string> LeaseVerbs = new Dictionary<string, string>
        {
            ["acquired"] = "took",
            ["takeover"] = "took over",
            ["assigned"] = "was assigned",
            ["resumed"] = "has again",
            ["consent"] = "was given",
            ["priority"] = "took over",
        };

        /// <summary>Return the sentence of an event. `nameOf`: the name of a participant by its id, empty for one that is not known.</summary>
        public static EventSentence Describe(EventKind body, Func<string, string> nameOf)
        {
            switch (body)
            {
                case ParticipantJoined joined:
                    return Info(joined.Participant.Name + (joined.Resumed ? " is back" : " joined as " + Plain(joined.Participant.Role)));
                case ParticipantLeft left:
                    string why = left.Reason.Length == 0 ? "" : " (" + Plain(left.Reason) + ")";
                    return left.Grace ? Warning(nameOf(left.Participant) + " lost the connection" + why + "; its leases are kept for a while") : Info(nameOf(left.Participant) + " left" + why);
                case LeaseChanged changed:
                    return Info(DescribeLease(changed.Lease, changed.Cause, changed.PreviousHolder, nameOf));
                case LeasesChanged changed:
                    return DescribeLeases(changed, nameOf);
                case ConsentRequested asked:
                    return Info(nameOf(asked.Requester) + " asks " + nameOf(asked.Holder) + " for " + asked.Target);
                case Intervention taken:
                    return taken.Active ? Warning(nameOf(taken.Human) + " overrides " + nameOf(taken.Agent) + " on " + taken.Robot) : Info(nameOf(taken.Agent) + " has " + taken.Robot + " again");
                case EngagementChanged engaged:
                    if (engaged.Engaged) return Info(nameOf(engaged.Participant) + " drives " + engaged.Robot);
                    return Info(engaged.Robot + " holds" + (engaged.Reason.Length == 0 ? "" : ": " + Words.OfHold(engaged.Reason).What));
                case ScaleChanged scaled:
                    return Info("motion of " + scaled.Robot + " is scaled by " + scaled.Scale.ToString("0.##", CultureInfo.InvariantCulture));
                case SceneChanged scene:
                    return Info(scene.Cause == "reset" ? "scene reset" : scene.Cause == "new_scene" ? "another scene" : scene.Cause == "patch" ? "scene changed" : "time of the scene went back");
                case EStopChanged stop:
                    if (!stop.Active) return Info(nameOf(stop.Participant) + " cleared the e-stop");
                    string by = nameOf(stop.Participant);
                    return new EventSentence(EventLevel.Error, "e-stop by " + (by.Length == 0 ? "a connection that has not joined" : by) + After(stop.Reason));
                case PauseChanged pause:
                    return Info((pause.Participant.Length == 0 ? "the session" : nameOf(pause.Participant)) + (pause.Paused ? " paused" : " resumed") + After(pause.Reason));
                case EpisodeChanged episode:
                    return Info("episode " + episode.Number + ": " + Plain(episode.State) + (episode.Label.Length == 0 ? "" : " (" + episode.Label + ")"));
                case ObjectGrasped grasped:
                    return Info(nameOf(grasped.Participant) + (grasped.Grasped ? " took " : " released ") + grasped.Object + " by hand");
                case Handover handed:
                    return Info(handed.Object + " was handed over from " + handed.Giver + " to " + handed.Receiver);
                case MarkerAdded marker:
                    return Info(nameOf(marker.Participant) + " notes: " + marker.Text);
                case SamplesRejected rejected:
                    return Warning(rejected.Count + " samples of " + nameOf(rejected.Participant) + " (" + rejected.Device + ") rejected: " + Plain(rejected.Reason));
                case Gap gap:
                    if (gap.Kind == "recording") return Warning("the recording lacks " + gap.Rows + " steps");
                    return Warning(gap.Kind == "resumed" ? "the session goes on from an earlier recording" : "the session stood still for " + Words.FormatAge(gap.DurationNs));
                case Notice notice:
                    return new EventSentence(notice.Level == "error" ? EventLevel.Error : notice.Level == "warning" ? EventLevel.Warning : EventLevel.Info, notice.Text);
                case Audited audited:
                    return Warning(JoinParts(Plain(audited.Kind), audited.Name, audited.Address, audited.Detail, audited.Count > 1 ? audited.Count + " times" : ""));
                default:
                    return DescribeAlignment(body, nameOf);
            }
        }

        private static EventSentence DescribeAlignment(EventKind body, Func<string, string> nameOf)
        {
            switch (body)
            {
                case AlignmentChanged aligned:
                    double error = aligned.Alignment.ErrorAtRobotM;
                    string within = error > 0.0 ? ", within " + Words.FormatLength(error) + " at the robot" : "";
                    return Info("alignment of " + nameOf(aligned.Participant) + ": " + (aligned.Alignment.Kind == AlignmentKind.None ? "not aligned" : Plain(aligned.Alignment.Kind)) + within);
                case AlignmentRun run:
                    return Info(nameOf(run.Participant) + (run.Running ? " measures its alignment" : " keeps its alignment"));
                case AlignmentAlarmed alarm:
                    if (alarm.Witnesses.Length > 0) return default; // a notice says once that the sheet was moved
                    string who = nameOf(alarm.Participant);
                    if (alarm.Kind == AlarmKind.TwoPlaces) return Warning(who + " sees " + alarm.AnchorId + " in two places: print each id once");
                    string size = Words.FormatLength(alarm.SizeM);
                    return Warning(alarm.Kind == AlarmKind.Jump ? "the tracking of " + who + " jumped by " + size + ": look at the sheet again" : who + " sees " + alarm.AnchorId + " " + size + " from where it was");
                case AnchorMoved moved:
                    return Info((moved.By.Length == 0 ? "a director" : nameOf(moved.By)) + " moved the anchor " + moved.AnchorId);
                case HeadsetsCompared compared:
                    bool isApart = compared.ErrorM > compared.ExpectedP95M;
                    if (!isApart && !compared.Touched) return default;
                    string text = nameOf(compared.A) + " and " + nameOf(compared.B) + (compared.Touched ? " touch " : " see ") + compared.AnchorId + " " + Words.FormatLength(compared.ErrorM)
                        + " apart, expected at most " + Words.FormatLength(compared.ExpectedP95M);
                    return isApart ? Warning(text) : Info(text);
                default:
                    return default;
            }
        }

        private static EventSentence DescribeLeases(LeasesChanged changed, Func<string, string> nameOf)
        {
            string[] sentences = new string[changed.Leases.Length];
            for (int i = 0; i < sentences.Length; i++) sentences[i] = DescribeLease(changed.Leases[i], changed.Cause, i < changed.PreviousHolders.Length ? changed.PreviousHolders[i] : "", nameOf);
            return Info(string.Join("; ", sentences));
        }

        private static string DescribeLease(Lease lease, string cause, string previous, Func<string, string> nameOf)
        {
            if (cause == "mode") return lease.Target + " is now " + Plain(lease.Mode);
            if (cause == "queue")
            {
                return lease.Queue.Length == 0 ? "the queue for " + lease.Target + " is empty" : string.Join(", ", Array.ConvertAll(lease.Queue, one => nameOf(one))) + " wait for " + lease.Target;
            }
            if (lease.Holder.Length == 0) return lease.Target + " is free" + (previous.Length == 0 ? "" : " (was held by " + nameOf(previous) + ")");
            string from = previous.Length > 0 && previous != lease.Holder ? " from " + nameOf(previous) : "";
            return nameOf(lease.Holder) + " " + (LeaseVerbs.TryGetValue(cause, out string verb) ? verb : "has") + " " + lease.Target + from;
        }

        private static EventSentence Info(string text) { return new EventSentence(EventLevel.Info, text); }

        private static EventSentence Warning(string text) { return new EventSentence(EventLevel.Warning, text); }

        private static string Plain(string value) { return value.Replace('_', ' '); }

        private static string After(string reason) { return reason.Length == 0 ? "" : ": " + reason; }

        private static string JoinParts(params string[] parts)
        {
            List<string> some = new List<string>();
            foreach (string part in parts) if (part.Length > 0) some.Add(part);
            return string.Join(", ", some);
        }
    }
}
