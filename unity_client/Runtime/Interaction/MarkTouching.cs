// Aligning by touching the marks of a sheet, for a headset that reads no codes: what the wearer does next, and what is reported to
// the session. Its words are in TouchWords.cs. As web_client/src/xr/touching.ts.
//
// The tip of a controller is calibrated by turning the controller while its tip stays in a hole. Then the tip is put on one mark
// after the other. Bare hands touch with a fingertip, and the other hand pinches: pinching moves the finger itself.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    public enum TouchStage
    {
        Off,

        /// <summary>A tip has to be calibrated: the trigger begins.</summary>
        Tip,
        Turn,

        /// <summary>The session computes where the tip is.</summary>
        Solve,
        Touch,

        /// <summary>A tip is on a mark, and rests.</summary>
        Rest,

        /// <summary>All marks are touched: the session computes the alignment.</summary>
        Wait,
        Done,
    }

    /// <summary>The procedure of one headset, from frame to frame. A frame allocates nothing; a touch does.</summary>
    public sealed class MarkTouching
    {
        /// <summary>A touch is the mean over this time [ns], in which a tip and a fingertip move less than this [m].</summary>
        public const long RestNs = 350_000_000;
        private const double StillTipM = 0.004;
        private const double StillFingerM = 0.012;

        /// <summary>Time for an answer, for a refusal after the last touch, and that the result is shown [ns].</summary>
        private const long AnswerNs = 4_000_000_000;
        private const long RefusalNs = 1_500_000_000;
        private const long DoneNs = 8_000_000_000;

        /// <summary>Name of the point that wearers touch to compare their worlds.</summary>
        private const string Point = "point";

        // By kind and side.
        private static readonly string[] Devices = { Device.ControllerLeft, Device.ControllerRight, Device.HandLeft, Device.HandRight };

        private readonly HandPress[] hands = { new HandPress(), new HandPress() };
        private readonly ControllerTip[] tips = new ControllerTip[2];
        private readonly TipTurns turns = new TipTurns();
        private long sinceNs;
        private int pressing; // side whose trigger or squeeze is held
        private int touching; // side whose tip rests
        private InputKind touchingKind;
        private Double3 first;
        private Double3 sum;
        private int count;
        private string solved = "";
        private bool isOffered;
        private bool isWanted; // a trigger was held: the next run of the alignment is ours
        private bool wasAsked;
        private bool isDeclined;
        private bool wasPlaced;
        private bool wasReady;
        private bool wantsTip;

        public readonly SheetMarks Marks = new SheetMarks();

        public TouchStage Stage { get; private set; }

        /// <summary>The wearer is at it: triggers, squeezes and the lower and upper buttons have the meaning that they have here.</summary>
        public bool IsActive { get { return Stage != TouchStage.Off && Stage != TouchStage.Done; } }

        /// <summary>What happened last, for people; empty for nothing.</summary>
        public string News { get; private set; } = "";

        /// <summary>There are hands, and no controller.</summary>
        public bool IsBare { get; private set; }

        /// <summary>The point that rests is one that others touch too.</summary>
        public bool IsCheck { get; private set; }

        /// <summary>Begin, by the wearer's own word: aligned or not.</summary>
        public void Begin()
        {
            Reset();
            wasAsked = true;
            isWanted = false;
            Stage = TouchStage.Touch;
        }

        /// <summary>The tracking frame is another one: touches are void. Tips are of the controllers, and stay.</summary>
        public void Reset()
        {
            Marks.Reset();
            News = "";
            isDeclined = wantsTip = false;
            if (IsActive) Stage = TouchStage.Touch;
        }

        /// <summary>Input does not reach the scene now: what is pressed when it does again counts from its next press.</summary>
        public void Suspend()
        {
            foreach (HandPress hand in hands) hand.Forget();
            if (Stage == TouchStage.Rest) Stage = TouchStage.Touch;
        }

        /// <summary>Take a frame.</summary>
        /// <param name="reading">The frame.</param>
        /// <param name="context">What hands point at: their triggers mean that.</param>
        /// <param name="session">Gets what is reported.</param>
        /// <param name="haptics">Null: there are no motors.</param>
        /// <param name="isOffered">Begin without being asked to when the headset is not aligned.</param>
        public void Update(HeadsetReading reading, HandContext context, ISessionPort session, IHaptics haptics, bool isOffered)
        {
            this.isOffered = isOffered;
            IsBare = IsEachBare(reading);
            Alignment alignment = FindAlignment(session);
            bool isReady = session.IsJoined && session.HasClock;
            bool isAnew = isReady && !wasReady; // the session has forgotten the touches of the last connection
            if ((wasPlaced && alignment == null) || (isAnew && Marks.TouchedCount > 0)) Reset();
            wasPlaced = alignment != null;
            wasReady = isReady;
            if (Marks.TakeSheets(session.Anchors)) Reset();
            if (Marks.Sheet == null) Stage = TouchStage.Off;
            ReadPresses(reading, context, session, isReady);
            if (Marks.Sheet != null && isReady) Step(reading, session, haptics, alignment);
        }

        /// <summary>Take what the session says.</summary>
        public void Take(ServerMessage message, ISessionPort session)
        {
            if (!(message is Event one)) return;
            string self = session.ParticipantId;
            if (one.Body is TipCalibrated answer && answer.Participant == self) TakeTip(answer);
            else if (one.Body is Notice notice && notice.Participant == self && notice.Reason == DenialReason.AlignmentRefused) TakeRefusal(notice.Text);
            else if (one.Body is AlignmentAlarmed alarmed && alarmed.Participant == self && alarmed.Kind == "jump") Reset();
            else if (one.Body is AlignmentRun run && run.Participant == self && run.Running && (isOffered || isWanted)) Begin();
            else if (one.Body is HeadsetsCompared compared && compared.Touched && (compared.A == self || compared.B == self))
                News = TouchWords.DescribeComparison(PanelWords.NameOf(session, compared.A == self ? compared.B : compared.A), compared);
        }

        /// <summary>Return one's own alignment, null for none in the present tracking frame.</summary>
        public static Alignment FindAlignment(ISessionPort session)
        {
            if (session.AlignmentState == AlignmentState.None) return null;
            return session.Participants.TryGetValue(session.ParticipantId, out ParticipantInfo self) ? self.Alignment : null;
        }

        /// <summary>Return whether an alignment states an error, with which it can be compared.</summary>
        public static bool IsComparable(Alignment alignment)
        {
            return alignment != null && alignment.Kind != AlignmentKind.Placed && alignment.Kind != AlignmentKind.NotNeeded;
        }

        /// <summary>Return how much of a rest, or of the turns of a calibration, is done.</summary>
        public double FindShare(long nowNs)
        {
            return Stage == TouchStage.Turn ? turns.Count / (double)TipTurns.Enough : (nowNs - sinceNs) / (double)RestNs;
        }

        /// <summary>Find where the next mark is expected, with the axes of its sheet. False: that is not known, or none is next.</summary>
        public bool TryFindExpected(ISessionPort session, out RigidTransform T_tracking_mark)
        {
            T_tracking_mark = RigidTransform.Identity;
            return (Stage == TouchStage.Touch || Stage == TouchStage.Rest) && Marks.TryFindNext(session, out T_tracking_mark);
        }

        /// <summary>Find the point of a hand that touches, in the tracking frame: a calibrated tip or a fingertip. False: it is not known, or not seen.</summary>
        public bool TryFindTip(HeadsetReading reading, Side side, out Double3 p_tracking_tip)
        {
            InputReading input = reading[side];
            bool isHand = input.Kind == InputKind.Hand;
            ControllerTip tip = isHand ? null : tips[(int)side];
            p_tracking_tip = isHand ? input.Tip : tip == null ? default : input.Pose.TransformPoint(tip.Position);
            return input.IsTracked && (isHand ? input.HasTip : tip != null);
        }

        private void ReadPresses(HeadsetReading reading, HandContext context, ISessionPort session, bool isReady)
        {
            for (int side = 0; side < 2; side++)
            {
                HandPress hand = hands[side];
                bool isBusy = context.Pointed[side].Length > 0 || context.Aimed[side].IsSomething;
                hand.Read(reading.Inputs[side], isBusy, isReady && !IsActive && Marks.Sheet != null, reading.CaptureNs);
                if (!hand.TakeHold(reading.CaptureNs)) continue;
                isWanted = true;
                session.Request(new Align { Action = AlignAction.Start, Participant = session.ParticipantId });
            }
        }

        private void Step(HeadsetReading reading, ISessionPort session, IHaptics haptics, Alignment alignment)
        {
            long nowNs = reading.CaptureNs;
            if (Stage == TouchStage.Off)
            {
                if (alignment != null || !isOffered || isDeclined) return;
                Reset();
                wasAsked = false;
                Stage = TouchStage.Touch;
            }
            long buttons = hands[0].PressedButtons | hands[1].PressedButtons;
            bool isNeedless = !wasAsked && ((alignment != null && alignment.Kind == AlignmentKind.Placed) || (!isOffered && Marks.TouchedCount == 0));
            if (IsActive && (buttons & ButtonBits.Upper) != 0) Leave(session, nowNs);
            else if (IsActive && isNeedless) Stage = TouchStage.Off;
            switch (Stage)
            {
                case TouchStage.Turn:
                    StepTurn(reading, session, haptics);
                    break;
                case TouchStage.Rest:
                    StepRest(reading, session, haptics);
                    break;
                case TouchStage.Solve:
                    if (nowNs - sinceNs > AnswerNs) Say(TouchStage.Tip, "The session did not answer: once more.");
                    break;
                case TouchStage.Wait:
                    if (alignment != null && nowNs - sinceNs >= RefusalNs) Finish(nowNs);
                    else if (nowNs - sinceNs >= AnswerNs)
                    {
                        Reset();
                        News = "The session did not answer: touch the marks once more.";
                    }
                    break;
                case TouchStage.Done:
                    if (nowNs - sinceNs > DoneNs) Stage = TouchStage.Off;
                    break;
                case TouchStage.Tip:
                case TouchStage.Touch:
                    if ((buttons & ButtonBits.Lower) != 0) wantsTip = true;
                    Stage = !wantsTip && CanTouch(reading) ? TouchStage.Touch : TouchStage.Tip;
                    for (int side = 0; side < 2; side++)
                    {
                        if (hands[side].IsTriggerPress) TakePress(side, reading, false);
                        if (hands[side].IsSqueezePress && IsComparable(alignment)) TakePress(side, reading, true);
                    }
                    break;
            }
        }

        /// <summary>Return whether there is something to touch with: a hand, or a controller whose tip is known.</summary>
        private bool CanTouch(HeadsetReading reading)
        {
            for (int side = 0; side < 2; side++)
                if (reading.Inputs[side].IsPresent && (reading.Inputs[side].Kind == InputKind.Hand || tips[side] != null)) return true;
            return false;
        }

        private void TakePress(int side, HeadsetReading reading, bool isCheck)
        {
            InputKind kind = reading.Inputs[side].Kind;
            if (Stage == TouchStage.Tip)
            {
                if (kind != InputKind.Controller || isCheck) return;
                turns.Clear();
                pressing = side;
                Say(TouchStage.Turn, "");
                return;
            }
            if (Stage != TouchStage.Touch) return;
            touching = kind == InputKind.Hand ? 1 - side : side;
            if (reading.Inputs[touching].Kind != kind || !TryFindTip(reading, (Side)touching, out first))
            {
                News = kind == InputKind.Hand
                    ? "The finger of the other hand is not seen."
                    : "The tip of this controller is not calibrated: A or X begins that.";
                return;
            }
            pressing = side;
            touchingKind = kind;
            IsCheck = isCheck;
            Stage = TouchStage.Rest;
            BeginRest(reading.CaptureNs, first);
        }

        private void BeginRest(long nowNs, Double3 p_tracking_tip)
        {
            sinceNs = nowNs;
            first = sum = p_tracking_tip;
            count = 1;
        }

        private void StepTurn(HeadsetReading reading, ISessionPort session, IHaptics haptics)
        {
            InputReading input = reading.Inputs[pressing];
            bool isPress = hands[pressing].IsTriggerPress;
            if (input.IsTracked && input.Kind == InputKind.Controller) turns.Add(input.Pose);
            bool isEnough = turns.Count >= TipTurns.Enough || (isPress && turns.Count >= TipTurns.Least);
            if (isEnough)
            {
                solved = Devices[pressing];
                session.ReportTipPoses(solved, turns.ToArray(), session.ToSessionNs(reading.CaptureNs));
                haptics?.Play((Side)pressing, Pulse.Touch);
                wantsTip = false;
                sinceNs = reading.CaptureNs;
                Stage = TouchStage.Solve;
            }
            else if (isPress) Say(TouchStage.Tip, "That was too little: go on turning until the bar is full.");
        }

        private void StepRest(HeadsetReading reading, ISessionPort session, IHaptics haptics)
        {
            bool isHeld = IsCheck ? hands[pressing].Squeeze : hands[pressing].Trigger;
            bool isThere = TryFindTip(reading, (Side)touching, out Double3 tip) && reading.Inputs[touching].Kind == touchingKind;
            if (!isHeld || !isThere) Say(TouchStage.Touch, "Keep the " + (IsCheck ? "squeeze" : "trigger") + " pressed for a moment, and hold still.");
            else if ((tip - first).Length > (touchingKind == InputKind.Hand ? StillFingerM : StillTipM)) BeginRest(reading.CaptureNs, tip);
            else
            {
                sum += tip;
                count++;
                if (reading.CaptureNs - sinceNs >= RestNs) Report(reading, session, haptics);
            }
        }

        private void Report(HeadsetReading reading, ISessionPort session, IHaptics haptics)
        {
            Double3 mean = (1.0 / count) * sum;
            ControllerTip tip = touchingKind == InputKind.Hand ? null : tips[touching];
            TouchReport report = new TouchReport
            {
                AnchorId = IsCheck ? Point : Marks.Sheet.Id,
                Mark = IsCheck ? null : Marks.Next,
                Device = Devices[2 * (int)touchingKind + touching],
                T_tracking_tip = new RigidTransform(mean, reading.Inputs[touching].Pose.Rotation),
                CaptureNs = session.ToSessionNs(reading.CaptureNs),
            };
            if (tip != null) report.Covariance = tip.MakeTouchCovariance();
            session.ReportTouch(report);
            haptics?.Play((Side)touching, Pulse.Touch);
            if (IsCheck)
            {
                Say(TouchStage.Touch, "Touched. Now another wearer, within a minute.");
                return;
            }
            Marks.TakeTouch(mean);
            sinceNs = reading.CaptureNs;
            Say(Marks.Next.Length > 0 ? TouchStage.Touch : TouchStage.Wait, "");
        }

        private void TakeTip(TipCalibrated answer)
        {
            bool isAwaited = Stage == TouchStage.Solve && solved == answer.Device;
            int side = Array.IndexOf(Devices, answer.Device);
            if (answer.Refused)
            {
                if (isAwaited) Say(TouchStage.Tip, answer.Advice);
                return;
            }
            if (side == (int)Side.Left || side == (int)Side.Right) tips[side] = new ControllerTip(answer);
            if (!isAwaited) return;
            Reset(); // touches with the earlier tip no longer count
            Say(TouchStage.Touch, "The tip is known to ± " + Words.FormatLength(answer.ErrorM) + ".");
        }

        private void TakeRefusal(string text)
        {
            if (!IsActive || Marks.Sheet == null) return;
            News = TouchWords.ShortenRefusal(text);
            Marks.TakeRefusal(text);
            if (Stage == TouchStage.Wait) Stage = TouchStage.Touch;
        }

        /// <summary>End before all is touched: what is aligned so far counts.</summary>
        private void Leave(ISessionPort session, long nowNs)
        {
            isDeclined = true;
            if (Marks.TouchedCount > 0 && session.AlignmentState == AlignmentState.Aligned) Finish(nowNs);
            else Stage = TouchStage.Off;
        }

        private void Finish(long nowNs)
        {
            sinceNs = nowNs;
            Say(TouchStage.Done, "");
        }

        private void Say(TouchStage stage, string news)
        {
            Stage = stage;
            News = news;
        }

        private static bool IsEachBare(HeadsetReading reading)
        {
            bool isAny = false;
            foreach (InputReading input in reading.Inputs)
            {
                if (input.IsPresent && input.Kind != InputKind.Hand) return false;
                isAny |= input.IsPresent;
            }
            return isAny;
        }
    }
}
