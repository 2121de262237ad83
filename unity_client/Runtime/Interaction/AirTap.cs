// Hands that have one gesture, the air tap: it is the trigger where a hand points at something to take or press, and the squeeze
// that moves a robot elsewhere. A grasp is then the gripper.
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Makes trigger and squeeze of taps. For devices such as HoloLens 2; call it before the input takes the frame.</summary>
    public sealed class AirTap
    {
        private const double Press = 0.6;
        private const double LetGo = 0.4;
        private readonly bool[] isDown = new bool[2];
        private readonly bool[] isClutch = new bool[2];

        /// <summary>Change the readings of a frame, by what hands pointed at in the frame before. What a tap is stays until it ends.</summary>
        public void Apply(HeadsetInput input)
        {
            for (int side = 0; side < 2; side++)
            {
                InputReading hand = input.Reading.Inputs[side];
                double tap = hand.Trigger;
                double grasp = hand.Squeeze;
                if (!isDown[side]) isClutch[side] = DrivesAndPointsElsewhere(input, (Side)side);
                isDown[side] = hand.IsTracked && (isDown[side] ? tap > LetGo : tap >= Press);
                hand.Trigger = isClutch[side] ? grasp : tap;
                hand.Squeeze = isClutch[side] ? tap : 0;
            }
        }

        /// <summary>A hand that drives a robot moves it, wherever it points, but for buttons and for other robots.</summary>
        private static bool DrivesAndPointsElsewhere(HeadsetInput input, Side side)
        {
            string driven = input.Hands.FindDriven(side);
            string pointed = input.FindPointed(side);
            return driven.Length > 0 && !input.FindAimed(side).IsSomething && (pointed.Length == 0 || pointed == driven);
        }
    }
}
