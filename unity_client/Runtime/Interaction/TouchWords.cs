// Lines of the panel before the eyes while marks are touched. As `describe` of web_client/src/xr/touching.ts.
using System;
using System.Text;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Makes texts of <see cref="MarkTouching"/>.</summary>
    public static class TouchWords
    {
        /// <summary>Append what to do next, each on a line; nothing while marks are of no use.</summary>
        public static void Describe(StringBuilder text, MarkTouching touching, ISessionPort session, long nowNs)
        {
            Alignment alignment = MarkTouching.FindAlignment(session);
            SheetMarks marks = touching.Marks;
            string sheet = marks.Sheet == null ? "" : "sheet '" + marks.Sheet.Id + "'";
            switch (touching.Stage)
            {
                case TouchStage.Off:
                    bool isUseful = marks.Sheet != null && !touching.IsBare && session.IsJoined && session.AlignmentState != AlignmentState.Aligned;
                    if (isUseful) PanelWords.Wrap(text, "To touch the marks of a sheet, hold a trigger for two seconds, pointing at no robot.");
                    break;
                case TouchStage.Tip:
                    text.Append("\nCalibrate the tip of a controller");
                    Say(text, touching.News);
                    PanelWords.Wrap(text, "Put the tip into a pricked hole of the " + sheet + ", and press the trigger.");
                    text.Append("\nB or Y: not now");
                    break;
                case TouchStage.Turn:
                    text.Append("\nTurn the controller, its tip in the hole\nTilt it to every side, and twist it.\n");
                    text.Append(PanelWords.DrawBar(touching.FindShare(nowNs))).Append("\nTrigger: that is enough");
                    break;
                case TouchStage.Solve:
                    text.Append("\nThe session computes where the tip is");
                    break;
                case TouchStage.Touch:
                    text.Append("\nTouch mark ").Append(marks.Next).Append(" (").Append(marks.TouchedCount + 1).Append(" of ").Append(marks.Sheet.Marks.Length).Append(')');
                    if (alignment != null && marks.TouchedCount > 0) PanelWords.Wrap(text, "So far: " + PanelWords.DescribeAlignment(alignment));
                    Say(text, touching.News);
                    DescribeHow(text, touching, sheet);
                    if (!touching.IsBare && MarkTouching.IsComparable(alignment)) text.Append("\nSqueeze: compare a point with another wearer");
                    break;
                case TouchStage.Rest:
                    text.Append('\n').Append(touching.IsCheck ? "Your common point" : "Mark " + marks.Next).Append(": hold still\n");
                    text.Append(PanelWords.DrawBar(touching.FindShare(nowNs)));
                    break;
                case TouchStage.Wait:
                    text.Append("\nThe session computes the alignment");
                    break;
                case TouchStage.Done:
                    PanelWords.Wrap(text, PanelWords.DescribeAlignment(alignment));
                    break;
            }
        }

        /// <summary>Return how far apart two worlds are at a point that both wearers touched.</summary>
        public static string DescribeComparison(string other, HeadsetsCompared compared)
        {
            string verdict = compared.ErrorM > 2 * compared.ExpectedP95M ? "too much" : "expected at most " + Words.FormatLength(compared.ExpectedP95M);
            return "You and " + other + " are " + Words.FormatLength(compared.ErrorM) + " apart at the touched point: " + verdict + ".";
        }

        /// <summary>Return a refusal without the words about who is refused.</summary>
        public static string ShortenRefusal(string text)
        {
            const string end = " refused: ";
            int at = text.StartsWith("alignment of ", StringComparison.Ordinal) ? text.IndexOf(end, StringComparison.Ordinal) : -1;
            return at < 0 ? text : text.Substring(at + end.Length);
        }

        private static void DescribeHow(StringBuilder text, MarkTouching touching, string sheet)
        {
            string mark = touching.Marks.Next;
            if (touching.IsBare)
            {
                PanelWords.Wrap(text, "Put a fingertip on cross " + mark + " of the " + sheet + ", and pinch with the other hand. A finger is good enough to look; to drive, take a controller.");
                return;
            }
            PanelWords.Wrap(text, "Put the tip into hole " + mark + " of the " + sheet + ", press the trigger and hold still.");
            text.Append("\nA or X: calibrate the tip again\nB or Y: ").Append(touching.Marks.TouchedCount < SheetMarks.Least ? "not now" : "that is enough");
        }

        private static void Say(StringBuilder text, string news)
        {
            if (news.Length > 0) PanelWords.Wrap(text, news);
        }
    }
}
