// Lines of the panels in the scene. As web_client/src/xr/words.ts; what is wrong and what to do has its words in the core.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Makes the text of panels.</summary>
    public static class PanelWords
    {
        /// <summary>Characters of a line.</summary>
        private const int Line = 44;

        /// <summary>Return the text of the panel at a robot: who holds it, why it stands still, what the trigger does.</summary>
        public static string DescribeRobot(ISessionPort session, string robot, Feedback feedback, bool isPointedAt, bool isRequested, double releaseShare)
        {
            session.Leases.TryGetValue(robot, out Lease lease);
            string holder = lease == null ? "" : lease.Holder;
            bool isOwn = lease != null && SessionMirror.IsHeldBy(lease, session.ParticipantId);
            string who = isOwn ? "you" : holder.Length == 0 ? "free" : NameOf(session, holder);
            StringBuilder text = new StringBuilder(robot).Append(": ").Append(who);
            if (session.IsStopped) text.Append("\nstopped by the e-stop");
            else if (isOwn && feedback != null && feedback.HoldReason.Length > 0) Wrap(text, "holds: " + Words.OfHold(feedback.HoldReason).What);
            int place = lease == null ? -1 : Array.IndexOf(lease.Queue, session.ParticipantId);
            if (place >= 0) text.Append("\nyou wait for it, place ").Append(place + 1).Append(" of ").Append(lease.Queue.Length);
            bool awaitsConsent = lease != null && lease.Mode == LeaseMode.Request && holder.Length > 0;
            if (isRequested && awaitsConsent) text.Append("\nwaiting for ").Append(who).Append("'s consent");
            else if (isPointedAt && isOwn) text.Append("\nhold the trigger to release it");
            else if (isPointedAt) text.Append("\npress the trigger to ").Append(awaitsConsent ? "ask for" : "take").Append(" it");
            if (releaseShare > 0) text.Append('\n').Append(DrawBar(releaseShare));
            return text.ToString();
        }

        /// <summary>Return the question of a participant who asks for one's robot, with the time that is left.</summary>
        public static string DescribeQuestion(ISessionPort session, ConsentQuestion question, long nowNs)
        {
            StringBuilder text = new StringBuilder();
            Wrap(text, NameOf(session, question.Requester) + " asks you for " + question.Target);
            long seconds = Math.Max(0, (question.UntilNs - nowNs + 999_999_999) / 1_000_000_000);
            return text.Append("\npoint at an answer, press the trigger: ").Append(seconds).Append(" s").ToString().TrimStart('\n');
        }

        /// <summary>Return the text beside a hand, empty when there is nothing to say.</summary>
        public static string DescribeHand(PoseValidity validity, Ignored ignored)
        {
            if (validity == PoseValidity.Emulated) return "out of sight: its place is a guess\nbring it before the headset's cameras";
            if (ignored == Ignored.Nothing) return "";
            return "let go, then " + (ignored == Ignored.Squeeze ? "squeeze" : "press") + " again";
        }

        /// <summary>Return the text above a hand: who one is, the alignment, what the hands drive.</summary>
        public static string DescribeSelf(ISessionPort session, HandInput hands)
        {
            session.Participants.TryGetValue(session.ParticipantId, out ParticipantInfo self);
            StringBuilder text = new StringBuilder(self == null ? "" : self.Name);
            Alignment alignment = session.AlignmentState == AlignmentState.None ? null : self?.Alignment;
            Wrap(text, DescribeAlignment(alignment));
            foreach (Side side in new[] { Side.Left, Side.Right })
            {
                string robot = hands.FindDriven(side);
                if (robot.Length > 0) text.Append(side == Side.Left ? "\nleft hand: " : "\nright hand: ").Append(robot);
            }
            return text.ToString().TrimStart('\n');
        }

        /// <summary>Return the line about one's own alignment; null: there is none.</summary>
        public static string DescribeAlignment(Alignment alignment)
        {
            if (alignment == null || alignment.Kind == AlignmentKind.None) return "not aligned";
            if (alignment.Kind == AlignmentKind.Placed) return "placed by a director, error not measured";
            if (alignment.Kind == AlignmentKind.NotNeeded) return "no alignment is needed";
            if (alignment.Offset) return "aligned, with an offset by hand";
            string error = alignment.ErrorAtRobotM > 0 ? " ± " + Words.FormatLength(alignment.ErrorAtRobotM) + " at the robot" : "";
            bool isViewOnly = alignment.Kind == AlignmentKind.Fingertip || alignment.Kind == AlignmentKind.Persistent;
            return (isViewOnly ? "to look, not to drive" : "aligned") + error;
        }

        /// <summary>Return what keeps codes from being read, for people; empty: nothing does.</summary>
        public static string DescribeMarkers(MarkerLooks markers)
        {
            if (markers == null) return "";
            switch (markers.Support)
            {
                case MarkerSupport.Missing:
                    return "This headset reads no codes: touch the marks of a sheet, or ask a director to place it.";
                case MarkerSupport.NotAllowed:
                    return "This app may not see sheets: allow it in the settings of the headset.";
                case MarkerSupport.Starting:
                    return "The search for sheets begins.";
                default:
                    return markers.Filter.OtherCode == null ? "" : "The code " + Quote(markers.Filter.OtherCode) + " is no sheet of this session.";
            }
        }

        /// <summary>Return the line about what happened to the headset, empty where nothing follows of it.</summary>
        public static string DescribeEvent(HeadsetEvent one, bool holdsRobots)
        {
            switch (one)
            {
                case HeadsetEvent.Recentred:
                    return "The room was recentred. Look at a sheet again" + (holdsRobots ? ", then open and close the clutch." : ".");
                case HeadsetEvent.PutOn:
                case HeadsetEvent.Focused:
                case HeadsetEvent.TrackingFound:
                    return holdsRobots ? "Robots held meanwhile: open and close the clutch." : "";
                default:
                    return "";
            }
        }

        /// <summary>Return how much of something is done, 0 to 1, as a bar.</summary>
        public static string DrawBar(double share)
        {
            int full = (int)Math.Ceiling(10 * Math.Min(1, share));
            return new string('|', full) + new string('.', 10 - full);
        }

        /// <summary>Append a text in lines of its own.</summary>
        public static void Wrap(StringBuilder target, string text)
        {
            int length = -1;
            foreach (string one in text.Split(' '))
            {
                string word = one;
                for (; word.Length > Line; word = word.Substring(Line)) target.Append('\n').Append(word, 0, Line);
                bool fits = length >= 0 && length + 1 + word.Length <= Line;
                target.Append(fits ? ' ' : '\n').Append(word);
                length = fits ? length + 1 + word.Length : word.Length;
            }
        }

        public static string NameOf(ISessionPort session, string participant)
        {
            return session.Participants.TryGetValue(participant, out ParticipantInfo info) ? info.Name : participant;
        }

        private static string Quote(string text)
        {
            return "\"" + (text.Length > 24 ? text.Substring(0, 24) + "..." : text) + "\"";
        }
    }
}
