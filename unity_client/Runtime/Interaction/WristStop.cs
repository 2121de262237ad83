// The e-stop of bare hands: a ball above the left wrist that the index finger of the right hand touches. As
// web_client/src/xr/stop.ts.
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Finds the touch that stops.</summary>
    public sealed class WristStop
    {
        /// <summary>Radius of the ball [m].</summary>
        public const double RadiusM = 0.035;

        /// <summary>The index finger is stretched when its tip is this far from the wrist [m]: 15 to 19 cm are usual, 8 to 10 in a fist.</summary>
        private const double StretchedM = 0.12;

        /// <summary>A touch counts when it has lasted this long: longer than one wrong reading, shorter than a finger on its way through.</summary>
        private const long TouchNs = 40_000_000;

        /// <summary>The ball stays where it was for this long when the wrist is lost: the other hand comes between it and the cameras.</summary>
        private const long KeepNs = 700_000_000;
        private const long Never = long.MinValue;

        // In the frame of the wrist: above the back of the hand, toward the elbow [m].
        private static readonly Double3 Offset = new Double3(-0.04, 0, 0.08);

        private long seenNs = Never;
        private long sinceNs = Never; // since when the finger is in the ball
        private bool isArmed; // the finger was outside since the ball has appeared, and since the last stop

        /// <summary>Where the ball is in the tracking frame.</summary>
        public Double3 Center { get; private set; }

        public bool HasBall { get; private set; }

        /// <summary>Take a frame. Returns whether it stops.</summary>
        public bool Update(HeadsetReading reading)
        {
            MoveBall(reading[Side.Left], reading.CaptureNs);
            InputReading right = reading[Side.Right];
            if (!HasBall) isArmed = false;
            if (!HasBall || !right.IsPresent || right.Kind != InputKind.Hand || !right.HasTip || !right.HasPose)
            {
                sinceNs = Never;
                return false;
            }
            bool isInside = (Center - right.Tip).Length <= RadiusM;
            bool isStretched = (right.Tip - right.Pose.Position).Length >= StretchedM;
            if (!isInside) isArmed = true;
            if (!isInside || !isStretched) sinceNs = Never;
            else if (sinceNs == Never) sinceNs = reading.CaptureNs;
            if (!isArmed || sinceNs == Never || reading.CaptureNs - sinceNs < TouchNs) return false;
            isArmed = false;
            return true;
        }

        /// <summary>Input does not reach the scene now: a finger that is in the ball when it does again stops nothing.</summary>
        public void Suspend()
        {
            HasBall = isArmed = false;
            sinceNs = seenNs = Never;
        }

        private void MoveBall(InputReading left, long nowNs)
        {
            if (left.IsTracked && left.HasTip) // its fingers are read: on HoloLens none are, and nothing could touch the ball
            {
                Center = left.Pose.TransformPoint(Offset);
                HasBall = true;
                seenNs = nowNs;
            }
            else if (seenNs == Never || nowNs - seenNs > KeepNs) HasBall = false;
        }
    }
}
