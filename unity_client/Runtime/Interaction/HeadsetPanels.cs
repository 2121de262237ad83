// Panels, buttons and rays of a headset: what they say and where they are, in the tracking frame. A layer draws them and decides
// nothing. As web_client/src/xr/props.ts and headset.ts.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>How a panel looks.</summary>
    public enum PanelStyle
    {
        /// <summary>What cannot wait, before the eyes.</summary>
        Urgent,
        Status,
        Hand,
        Robot,
        Question,
        Button,
        AimedButton,
        Stop,
    }

    /// <summary>A text in the room, which faces the eyes. Made once and filled again.</summary>
    public sealed class Panel
    {
        public string Text = "";
        public PanelStyle Style;

        /// <summary>Middle of its lower edge, in the tracking frame.</summary>
        public Double3 At;

        /// <summary>Height of a line [m].</summary>
        public double LineM;

        /// <summary>It is drawn.</summary>
        public bool IsShown { get { return Text.Length > 0; } }
    }

    /// <summary>The ray of a hand. Without a length there is none.</summary>
    public struct PanelRay
    {
        public AimRay Ray;
        public double LengthM;
        public bool IsHit;
    }

    /// <summary>Panels and rays for a layer to draw.</summary>
    public interface IPanels
    {
        /// <summary>Every panel, shown or not: a layer makes one object for each.</summary>
        IReadOnlyList<Panel> All { get; }

        /// <summary>Of the left and of the right hand; beyond those other lines, such as the one to the mark that is touched next.</summary>
        PanelRay[] Rays { get; }
    }

    /// <summary>Decides about panels. For the engine's thread; texts are made ten times a second.</summary>
    public sealed class HeadsetPanels : IPanels
    {
        /// <summary>Panels of robots; of more the rest have none.</summary>
        public const int MaxRobots = 12;
        private const int MaxButtons = 2 + ButtonPanel.MaxCommands;
        private const int MaxAdvice = 3;

        /// <summary>Characters of a notice: those of the session say first what is wrong, then what to do.</summary>
        private const int MaxNotice = 240;
        private const long PeriodNs = 100_000_000;

        /// <summary><see cref="WearerNews"/> are shown for so long.</summary>
        private const long NewsNs = 5_000_000_000;

        /// <summary>Length of a ray that meets nothing [m].</summary>
        private const double RayM = 2;
        private const double AboveRobotM = 0.18;
        private const double AboveHandM = 0.13;
        private const double BelowHandM = 0.06;

        /// <summary>Height of the line above the mark that is touched next [m].</summary>
        private const double PoleM = 0.1;

        // Before the eyes: ahead and below, out of the way of the hands.
        private static readonly Double3 UrgentAt = new Double3(0.9, 0, -0.3);

        public readonly Panel Urgent = new Panel { Style = PanelStyle.Urgent, LineM = 0.03 };
        public readonly Panel Status = new Panel { Style = PanelStyle.Status, LineM = 0.012 };
        public readonly Panel Question = new Panel { Style = PanelStyle.Question, LineM = 0.03 };
        public readonly Panel Stop = new Panel { Style = PanelStyle.Stop, LineM = 0.018 };
        public readonly Panel Mark = new Panel { Style = PanelStyle.Status, LineM = 0.02 };
        public readonly Panel[] Hands = { new Panel { Style = PanelStyle.Hand, LineM = 0.012 }, new Panel { Style = PanelStyle.Hand, LineM = 0.012 } };
        public readonly Panel[] Robots;
        public readonly Panel[] Buttons = Make(MaxButtons, PanelStyle.Button, 0.03);
        private readonly List<Panel> all = new List<Panel>();
        private readonly HeadsetInput input;
        private readonly ISessionPort session;
        private readonly IBodies bodies;
        private readonly StringBuilder text = new StringBuilder();
        private long textsAt = long.MinValue;

        /// <param name="maxRobots">Panels of robots: each is a draw call.</param>
        public HeadsetPanels(HeadsetInput input, ISessionPort session, IBodies bodies, int maxRobots = MaxRobots)
        {
            Robots = Make(maxRobots, PanelStyle.Robot, 0.03);
            this.input = input;
            this.session = session;
            this.bodies = bodies;
            all.Add(Urgent);
            all.Add(Status);
            all.Add(Question);
            all.Add(Stop);
            all.Add(Mark);
            all.AddRange(Hands);
            all.AddRange(Robots);
            all.AddRange(Buttons);
        }

        public IReadOnlyList<Panel> All { get { return all; } }

        public PanelRay[] Rays { get; } = new PanelRay[3];

        /// <summary>Take a frame, after the input. `advice`: what is wrong, the most urgent first; `notice`: words of the application.</summary>
        public void Update(IReadOnlyList<Advice> advice, string notice)
        {
            HeadsetReading reading = input.Reading;
            if (reading.CaptureNs - textsAt >= PeriodNs || textsAt == long.MinValue)
            {
                textsAt = reading.CaptureNs;
                MakeTexts(advice, notice);
            }
            PlaceTexts(reading);
            PlaceButtons();
            PlaceMark();
            for (int side = 0; side < 2; side++) Rays[side] = FindRay(side);
        }

        /// <summary>Return the rotation of a panel that faces a head: x away from it, z up.</summary>
        public static DoubleQuaternion Face(Double3 at, Double3 p_tracking_head)
        {
            Double3 line = at - p_tracking_head;
            double level = Math.Sqrt(line.X * line.X + line.Y * line.Y);
            DoubleQuaternion yaw = DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), Math.Atan2(line.Y, line.X));
            return yaw * DoubleQuaternion.FromAxisAngle(new Double3(0, 1, 0), -Math.Atan2(line.Z, level));
        }

        private void MakeTexts(IReadOnlyList<Advice> advice, string notice)
        {
            long nowNs = input.Reading.CaptureNs;
            text.Clear();
            if (input.Stop.IsUnconfirmed) WrapIfAny(StopReport.Unconfirmed.ToString());
            WearerNews news = input.News;
            if (nowNs - news.DenialNs < NewsNs) WrapIfAny(Words.OfDenial(news.Denial).ToString());
            if (nowNs - news.NoticeNs < NewsNs) WrapIfAny(Words.ToLine(news.Notice, MaxNotice));
            int said = 0;
            foreach (Advice one in advice)
            {
                if (said == MaxAdvice || !IsSaidHere(one)) continue;
                PanelWords.Wrap(text, one.Phrase.ToString());
                said++;
            }
            if (session.IsJoined && session.AlignmentState == AlignmentState.None && !input.Touching.IsActive) WrapIfAny(PanelWords.DescribeMarkers(input.Markers));
            TouchWords.Describe(text, input.Touching, session, nowNs);
            WrapIfAny(input.Episode.Describe());
            if (nowNs - news.EventNs < NewsNs) WrapIfAny(PanelWords.DescribeEvent(news.Event, input.HoldsRobots));
            WrapIfAny(notice);
            Set(Urgent, text.ToString().TrimStart('\n'));
            Set(Status, PanelWords.DescribeSelf(session, input.Hands));
            ConsentQuestion asked = input.Question;
            string waiting = input.AwaitedRobot.Length == 0 ? "" : "waiting for consent to " + input.AwaitedRobot;
            Set(Question, asked != null ? PanelWords.DescribeQuestion(session, asked, nowNs) : waiting);
            Stop.Text = input.WristStop.HasBall ? "STOP" : "";
            for (int side = 0; side < 2; side++)
            {
                InputReading hand = input.Reading.Inputs[side];
                Set(Hands[side], hand.IsPresent && hand.HasPose ? PanelWords.DescribeHand(hand.Validity, input.Hands.FindIgnored((Side)side)) : "");
            }
            for (int i = 0; i < Robots.Length; i++) Set(Robots[i], i < input.Pointing.Robots.Count ? DescribeRobot(input.Pointing.Robots[i], nowNs) : "");
        }

        /// <summary>What a robot holds for is said at the robot, and an open clutch is no trouble. A denial is said first, and who is aligned needs no sheet.</summary>
        private bool IsSaidHere(Advice one)
        {
            bool isAboutSheets = one.Kind == AdviceKind.NoMarkers || (one.Kind == AdviceKind.Permission && one.Reason == "sheets");
            return one.Kind != AdviceKind.Holding && one.Kind != AdviceKind.Denied && !(isAboutSheets && session.AlignmentState == AlignmentState.Aligned);
        }

        private void WrapIfAny(string line)
        {
            if (!string.IsNullOrEmpty(line)) PanelWords.Wrap(text, line);
        }

        private string DescribeRobot(string robot, long nowNs)
        {
            double share = 0;
            bool isPointedAt = false;
            for (int side = 0; side < 2; side++)
            {
                if (input.FindPointed((Side)side) != robot) continue;
                isPointedAt = true;
                share = Math.Max(share, input.Hands.FindReleaseShare((Side)side, nowNs));
            }
            return PanelWords.DescribeRobot(session, robot, input.FindFeedback(robot), isPointedAt, input.IsRequested(robot), share);
        }

        private void PlaceTexts(HeadsetReading reading)
        {
            if (reading.HasHead) Urgent.At = reading.Head.TransformPoint(UrgentAt);
            Question.At = input.Buttons.QuestionAt;
            if (!input.Buttons.HasQuestion) Question.Text = "";
            Stop.At = input.WristStop.Center + new Double3(0, 0, WristStop.RadiusM);
            InputReading own = reading[Side.Left].IsTracked ? reading[Side.Left] : reading[Side.Right];
            if (!own.IsTracked) Status.Text = "";
            Status.At = own.Pose.Position + new Double3(0, 0, AboveHandM);
            for (int side = 0; side < 2; side++) Hands[side].At = reading.Inputs[side].Pose.Position - new Double3(0, 0, BelowHandM);
            bool isPlaced = session.TryGetAlignment(out RigidTransform T_world_tracking);
            RigidTransform T_tracking_world = T_world_tracking.Inverse;
            for (int i = 0; i < Robots.Length && i < input.Pointing.Robots.Count; i++)
            {
                Double3 top = default;
                bool isThere = isPlaced && input.Pointing.TryFindTop(input.Pointing.Robots[i], bodies, out top);
                if (!isThere) Robots[i].Text = "";
                Robots[i].At = T_tracking_world.TransformPoint(top + new Double3(0, 0, AboveRobotM));
            }
        }

        private void PlaceButtons()
        {
            IReadOnlyList<ShownButton> shown = input.Buttons.Shown;
            for (int i = 0; i < Buttons.Length; i++)
            {
                Panel panel = Buttons[i];
                panel.Text = i < shown.Count ? shown[i].Text : "";
                if (i >= shown.Count) continue;
                panel.At = shown[i].At;
                panel.Style = shown[i].IsAimed ? PanelStyle.AimedButton : PanelStyle.Button;
                panel.LineM = shown[i].Button.Id >= Button.FirstCommand ? 0.018 : 0.038;
            }
        }

        private void PlaceMark()
        {
            bool isThere = input.Touching.TryFindExpected(session, out RigidTransform T_tracking_mark);
            Mark.Text = isThere ? input.Touching.Marks.Next : "";
            Double3 up = T_tracking_mark.Rotation.Rotate(new Double3(0, 0, 1));
            Mark.At = T_tracking_mark.Position + PoleM * up;
            Rays[2] = isThere ? new PanelRay { Ray = new AimRay(Mark.At, -up), LengthM = PoleM, IsHit = true } : default;
        }

        /// <summary>Return the ray of a hand; while marks are touched, the line to the tip of its controller.</summary>
        private PanelRay FindRay(int side)
        {
            InputReading hand = input.Reading.Inputs[side];
            bool isAtTip = input.Touching.IsActive && hand.Kind == InputKind.Controller && !input.FindAimed((Side)side).IsSomething;
            if (isAtTip && input.Touching.TryFindTip(input.Reading, (Side)side, out Double3 tip))
            {
                Double3 line = tip - hand.Pose.Position;
                return new PanelRay { Ray = new AimRay(hand.Pose.Position, (1 / line.Length) * line), LengthM = line.Length, IsHit = true };
            }
            if (!hand.IsTracked || !hand.HasRay) return default;
            double hit = input.FindHit((Side)side);
            return new PanelRay { Ray = hand.Ray, LengthM = hit > 0 ? hit : RayM, IsHit = hit > 0 };
        }

        private static void Set(Panel panel, string text)
        {
            if (panel.Text != text) panel.Text = text;
        }

        private static Panel[] Make(int count, PanelStyle style, double lineM)
        {
            Panel[] panels = new Panel[count];
            for (int i = 0; i < count; i++) panels[i] = new Panel { Style = style, LineM = lineM };
            return panels;
        }
    }
}
