// What a person's hands mean, frame by frame: which hand drives which robot, what is asked of the session, and the samples that
// are sent. As web_client/src/xr/hands.ts.
//
// A trigger pressed at a robot acquires it; held at one's own robot it releases it; pressed at a button it presses that. A squeeze
// moves the robot of that hand, and the trigger is its gripper meanwhile. Buttons that are held when a hand appears count from
// their next press; only the e-stop counts always.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>What a hand holds that does not count before it is let go.</summary>
    public enum Ignored
    {
        Nothing,
        Squeeze,
        Trigger,
    }

    /// <summary>State of both hands. Allocates nothing after the first frames.</summary>
    public sealed class HandInput
    {
        // A value is pressed from the first on, and until it falls below the second.
        private const double Press = 0.6;
        private const double LetGo = 0.4;

        /// <summary>A trigger held this long at one's own robot releases it.</summary>
        public const long ReleaseNs = 800_000_000;

        /// <summary>A trigger pressed at nothing for no longer than this asks to be placed: a longer press is no tap.</summary>
        private const long TapNs = 800_000_000;

        /// <summary>After so long without a frame hands are new ones: what they did meanwhile is not known.</summary>
        private const long GapNs = 500_000_000;

        /// <summary>A lease that was granted is seen within this time.</summary>
        private const long GrantedNs = 2_000_000_000;

        /// <summary>The clutch of a hand that has got a robot stays open this long: a session engages after it has seen it open.</summary>
        private const long OpenNs = 100_000_000;
        private const int Sides = 2;

        /// <summary>What means something else while marks are touched.</summary>
        private const long TouchingButtons = ButtonBits.Trigger | ButtonBits.Squeeze | ButtonBits.Lower | ButtonBits.Upper;
        private const long Never = long.MinValue;

        private sealed class Hand
        {
            public bool IsKnown;
            public InputKind Kind;
            public bool Trigger;
            public bool Squeeze;
            public bool MustLetGo; // the squeeze was held when the hand appeared, and has not been let go since
            public bool MustLetGoTrigger;
            public long PressedNs; // when the trigger was pressed at one's own robot
            public string PressedAt = "";
            public long TappedNs; // when the trigger was pressed at nothing
            public string Driven = "";
            public string Wanted = ""; // asked for, until it is held or denied
            public long WantedUntilNs;
            public long BoundNs = Never; // when it got its robot
            public double? Grasp; // what is asked of the gripper in this frame
            public bool Stop;
        }

        private readonly Hand[] hands = { new Hand(), new Hand() };
        private readonly Grips grips = new Grips();
        private readonly List<string> free = new List<string>();
        private readonly List<string> guessed = new List<string>();
        private readonly SampleInput head = new SampleInput { Device = Device.Head };
        private readonly SampleInput gaze = new SampleInput { Device = Device.Gaze };
        private readonly SampleInput[] controllers = { new SampleInput { Device = Device.ControllerLeft }, new SampleInput { Device = Device.ControllerRight } };
        private readonly SampleInput[] bare = { new SampleInput { Device = Device.HandLeft }, new SampleInput { Device = Device.HandRight } };
        private long frameNs = Never;
        private bool isTouching;
        private bool wasTouching;
        private readonly long[] withheld = new long[Sides];

        /// <summary>Take the buttons of the e-stop. Returns whether one is pressed that was not in the frame before.</summary>
        public bool TakeStops(HeadsetReading reading)
        {
            bool isPress = false;
            for (int side = 0; side < Sides; side++)
            {
                bool isStop = (reading.Inputs[side].Buttons & ButtonBits.Stop) != 0;
                isPress |= isStop && !hands[side].Stop;
                hands[side].Stop = isStop;
            }
            return isPress;
        }

        /// <summary>Take a frame. Adds what it asks of the session to `intents`.</summary>
        public void Update(HeadsetReading reading, HandContext context, List<HandIntent> intents)
        {
            long nowNs = reading.CaptureNs;
            double seconds = frameNs == Never ? 0 : (nowNs - frameNs) * 1e-9;
            if (frameNs == Never || nowNs - frameNs > GapNs) Suspend();
            frameNs = nowNs;
            if (isTouching != context.IsTouching) Suspend();
            wasTouching = isTouching;
            isTouching = context.IsTouching;
            guessed.Clear();
            guessed.AddRange(context.Guessed);
            foreach (Hand hand in hands) if (hand.Driven.Length > 0 && !context.Held.Contains(hand.Driven)) hand.Driven = "";
            for (int side = 0; side < Sides; side++)
            {
                InputReading input = reading.Inputs[side];
                if (input.IsTracked) UpdateHand(side, input, nowNs, context, intents);
                else hands[side].IsKnown = false;
            }
            BindWanted(context.Held, nowNs);
            UpdateGrips(reading, context, seconds);
        }

        /// <summary>Input does not reach the scene now: what is pressed when it does again counts from its next press.</summary>
        public void Suspend()
        {
            foreach (Hand hand in hands)
            {
                hand.IsKnown = false;
                hand.Squeeze = hand.Trigger = false;
            }
        }

        /// <summary>The session has answered a request for a robot.</summary>
        public void Settle(string robot, bool isGranted, long nowNs)
        {
            foreach (Hand hand in hands)
            {
                if (hand.Wanted != robot) continue;
                if (isGranted) hand.WantedUntilNs = nowNs + GrantedNs;
                else hand.Wanted = "";
            }
        }

        /// <summary>Return the robot that a hand drives, empty for none.</summary>
        public string FindDriven(Side side)
        {
            return hands[(int)side].Driven;
        }

        /// <summary>Return whether a hand drives a robot, and which one.</summary>
        public bool TryFindDriver(string robot, out Side side)
        {
            side = hands[(int)Side.Right].Driven == robot ? Side.Right : Side.Left;
            return hands[(int)side].Driven == robot && robot.Length > 0;
        }

        /// <summary>Return whether a hand holds its squeeze.</summary>
        public bool IsSqueezing(Side side)
        {
            return hands[(int)side].IsKnown && hands[(int)side].Squeeze;
        }

        /// <summary>Return what a hand holds that does not count before it is let go.</summary>
        public Ignored FindIgnored(Side side)
        {
            Hand hand = hands[(int)side];
            if (!hand.IsKnown) return Ignored.Nothing;
            if (hand.MustLetGo) return Ignored.Squeeze;
            return hand.MustLetGoTrigger && !hand.Squeeze ? Ignored.Trigger : Ignored.Nothing;
        }

        /// <summary>Return how far a hand is on the way to release its robot, 0 to 1.</summary>
        public double FindReleaseShare(Side side, long nowNs)
        {
            Hand hand = hands[(int)side];
            if (!hand.IsKnown || hand.PressedNs == Never) return 0;
            return Math.Min(1, (nowNs - hand.PressedNs) / (double)ReleaseNs);
        }

        /// <summary>Add the inputs of a frame's samples.</summary>
        /// <param name="reading">The frame.</param>
        /// <param name="isVisible">The person sees the scene, and their input reaches it.</param>
        /// <param name="captureNs">The time of the frame, of the session [ns].</param>
        /// <param name="samples">Gets inputs that are valid until the next call.</param>
        public void MakeInputs(HeadsetReading reading, bool isVisible, long captureNs, List<SampleInput> samples)
        {
            if (reading.HasHead)
            {
                head.CaptureNs = captureNs;
                head.Pose = reading.Head;
                head.Validity = isVisible ? reading.HeadValidity : PoseValidity.NotSeen;
                samples.Add(head);
            }
            if (reading.HasGaze)
            {
                gaze.CaptureNs = captureNs;
                gaze.Pose = reading.Gaze;
                gaze.Validity = isVisible ? reading.GazeValidity : PoseValidity.NotSeen;
                samples.Add(gaze);
            }
            for (int side = 0; side < Sides; side++)
            {
                InputReading input = reading.Inputs[side];
                if (!input.IsPresent || !input.HasPose) continue;
                Hand hand = hands[side];
                SampleInput sample = (input.Kind == InputKind.Hand ? bare : controllers)[side];
                sample.CaptureNs = captureNs;
                sample.Pose = input.Pose;
                sample.Validity = isVisible ? input.Validity : PoseValidity.NotSeen;
                sample.Robots.Clear();
                // A sample of an estimated pose that names its robot is rejected: until the session says that it holds for that.
                bool isNamed = hand.Driven.Length > 0 && !(input.Validity == PoseValidity.Emulated && guessed.Contains(hand.Driven));
                if (isNamed) sample.Robots.Add(hand.Driven);
                sample.Clutch = IsSqueezing((Side)side) && (hand.BoundNs == Never || reading.CaptureNs - hand.BoundNs >= OpenNs);
                sample.Gripper = sample.Clutch ? hand.Grasp : null;
                sample.Buttons = MaskButtons(side, input);
                sample.HandJoints = isVisible ? input.Joints : InputReading.NoJoints;
                samples.Add(sample);
            }
        }

        private void UpdateHand(int side, InputReading input, long nowNs, HandContext context, List<HandIntent> intents)
        {
            Hand hand = hands[side];
            bool isNew = !hand.IsKnown || hand.Kind != input.Kind;
            bool hadTrigger = hand.Trigger, hadSqueeze = hand.Squeeze;
            bool isSqueezed = IsPressed(isTouching ? 0 : input.Squeeze, isNew || hadSqueeze || hand.MustLetGo);
            bool trigger = IsPressed(input.Trigger, isNew || hadTrigger);
            hand.MustLetGo = isSqueezed && (isNew || hand.MustLetGo);
            hand.MustLetGoTrigger = trigger && (isNew || hand.MustLetGoTrigger);
            hand.IsKnown = true;
            hand.Kind = input.Kind;
            hand.Trigger = trigger;
            hand.Squeeze = isSqueezed && !hand.MustLetGo;
            if (isNew)
            {
                hand.PressedNs = hand.TappedNs = Never;
                hand.PressedAt = "";
                return;
            }
            if (hand.Squeeze && !hadSqueeze) BeginSqueeze(side, context.Held);
            ReadTrigger(side, hadTrigger, nowNs, context, intents);
        }

        private void ReadTrigger(int side, bool wasPressed, long nowNs, HandContext context, List<HandIntent> intents)
        {
            Hand hand = hands[side];
            string robot = context.Pointed[side];
            Button button = context.Aimed[side];
            bool isPress = hand.Trigger && !wasPressed && !hand.Squeeze;
            if (!hand.Trigger || hand.Squeeze || robot != hand.PressedAt) hand.PressedNs = Never;
            if (hand.Squeeze || robot.Length > 0 || button.IsSomething) hand.TappedNs = Never;
            if (isPress && button.IsSomething) intents.Add(new HandIntent(IntentKind.Press, button: button));
            else if (isTouching) hand.PressedNs = hand.TappedNs = Never;
            else if (isPress && robot.Length > 0) PressAt(robot, side, nowNs, context.Held, intents);
            else if (isPress) hand.TappedNs = nowNs;
            if (hand.PressedNs != Never && nowNs - hand.PressedNs >= ReleaseNs)
            {
                hand.PressedNs = Never;
                intents.Add(new HandIntent(IntentKind.Release, hand.PressedAt));
            }
            if (hand.Trigger || hand.TappedNs == Never) return;
            if (nowNs - hand.TappedNs <= TapNs && context.CanPlace) intents.Add(new HandIntent(IntentKind.Place));
            hand.TappedNs = Never;
        }

        private void PressAt(string robot, int side, long nowNs, List<string> held, List<HandIntent> intents)
        {
            Hand hand = hands[side];
            bool isMoved = false;
            for (int other = 0; other < Sides; other++) isMoved |= hands[other].Driven == robot && IsSqueezing((Side)other);
            if (!held.Contains(robot))
            {
                hand.Wanted = robot;
                hand.WantedUntilNs = long.MaxValue;
                intents.Add(new HandIntent(IntentKind.Acquire, robot));
            }
            else if (hand.Driven == robot)
            {
                hand.PressedNs = nowNs;
                hand.PressedAt = robot;
            }
            else if (!isMoved) Bind(side, robot);
        }

        /// <summary>Give hands the robots that they asked for.</summary>
        private void BindWanted(List<string> held, long nowNs)
        {
            for (int side = 0; side < Sides; side++)
            {
                Hand hand = hands[side];
                if (hand.Wanted.Length == 0) continue;
                if (held.Contains(hand.Wanted)) Bind(side, hand.Wanted);
                else if (nowNs > hand.WantedUntilNs) hand.Wanted = "";
            }
        }

        private void UpdateGrips(HeadsetReading reading, HandContext context, double seconds)
        {
            grips.KeepOnly(context.Held);
            for (int side = 0; side < Sides; side++)
            {
                Hand hand = hands[side];
                hand.Grasp = null;
                if (hand.Driven.Length == 0) continue;
                if (!reading.Inputs[side].IsTracked || !IsSqueezing((Side)side))
                {
                    grips.LetGo(hand.Driven);
                    continue;
                }
                Tenure? tenure = context.Tenures.TryGetValue(hand.Driven, out Tenure found) ? found : (Tenure?)null;
                hand.Grasp = grips.Follow(hand.Driven, tenure, reading.Inputs[side].Trigger, context.Following.Contains(hand.Driven), seconds);
            }
        }

        /// <summary>Let a hand drive a robot, and no other hand.</summary>
        private void Bind(int side, string robot)
        {
            for (int other = 0; other < Sides; other++)
            {
                if (hands[other].Driven == robot) hands[other].Driven = "";
                if (other == side || hands[other].Wanted == robot) hands[other].Wanted = "";
            }
            hands[side].Driven = robot;
            hands[side].BoundNs = frameNs;
        }

        /// <summary>
        /// A hand without a robot drives one that is held and that no hand drives: the one named after its side, or the first.
        ///
        /// What it asked for before is not given to it any more: a hand that works must not find itself at another robot.
        /// </summary>
        private void BeginSqueeze(int side, List<string> held)
        {
            hands[side].Wanted = "";
            if (hands[side].Driven.Length > 0) return;
            free.Clear();
            foreach (string robot in held) if (robot != hands[0].Driven && robot != hands[1].Driven) free.Add(robot);
            if (free.Count == 0) return;
            string named = side == (int)Side.Left ? "left" : "right";
            string best = free[0];
            foreach (string robot in free)
            {
                if (robot.IndexOf(named, StringComparison.OrdinalIgnoreCase) < 0) continue;
                best = robot;
                break;
            }
            Bind(side, best);
        }

        /// <summary>Return the buttons without those that are pressed for marks that are touched: these count from their next press.</summary>
        private long MaskButtons(int side, InputReading input)
        {
            bool isForMarks = isTouching || wasTouching; // the press that ends it, too
            withheld[side] = input.Buttons & (isForMarks ? TouchingButtons : withheld[side]);
            return input.Buttons & ~withheld[side];
        }

        private static bool IsPressed(double value, bool before)
        {
            return before ? value > LetGo : value >= Press;
        }
    }
}
