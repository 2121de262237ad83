// What a headset says at one frame, in the axes of the wire: the border between an engine and everything that is decided. Also
// what a bare hand means: pinch and fist as values of a trigger and a squeeze. As web_client/src/xr/reading.ts.
using System;
using IrisSession.Core;

namespace IrisSession.Interaction
{
    public enum Side
    {
        Left = 0,
        Right = 1,
    }

    public enum InputKind
    {
        Controller,
        Hand,
    }

    /// <summary>A ray in some frame. `Direction`: unit vector.</summary>
    public readonly struct AimRay
    {
        public readonly Double3 Origin;
        public readonly Double3 Direction;

        public AimRay(Double3 origin, Double3 direction)
        {
            Origin = origin;
            Direction = direction;
        }

        /// <summary>Return the ray along the forward axis of a pose: x, in the axes of the wire.</summary>
        public static AimRay Along(RigidTransform pose)
        {
            return new AimRay(pose.Position, pose.Rotation.Rotate(new Double3(1, 0, 0)));
        }

        /// <summary>Return this ray of frame b in frame a.</summary>
        public AimRay In(RigidTransform T_a_b)
        {
            return new AimRay(T_a_b.TransformPoint(Origin), T_a_b.Rotation.Rotate(Direction));
        }
    }

    /// <summary>Bits of `Sample.buttons`: docs/protocol.md, section 6.</summary>
    public static class ButtonBits
    {
        public const long Trigger = 1;
        public const long Squeeze = 2;
        public const long Touchpad = 4;
        public const long Thumbstick = 8;
        public const long Lower = 16;
        public const long Upper = 32;
        public const long Rest = 64;
        public const long Menu = 128;

        /// <summary>Buttons of the e-stop: controllers without a thumbstick have a pad.</summary>
        public const long Stop = Thumbstick | Touchpad;
    }

    /// <summary>A controller or a hand at one frame. Poses in the tracking frame. Made once and filled again.</summary>
    public sealed class InputReading
    {
        /// <summary>False: there is no such device.</summary>
        public bool IsPresent;
        public InputKind Kind;

        /// <summary>`T_tracking_device`, the last known one of a device that is lost. Without one it was never seen.</summary>
        public RigidTransform Pose;
        public bool HasPose;

        /// <summary>What the runtime knows of the pose, by the flags of the device itself.</summary>
        public PoseValidity Validity;

        /// <summary>Where it points.</summary>
        public AimRay Ray;
        public bool HasRay;

        /// <summary>0 open to 1 closed.</summary>
        public double Trigger;
        public double Squeeze;

        /// <summary>Bits of <see cref="ButtonBits"/>; those of the e-stop also while the device is lost.</summary>
        public long Buttons;

        /// <summary>Tip of the index finger of a bare hand that is tracked.</summary>
        public Double3 Tip;
        public bool HasTip;

        /// <summary>Rows of a bare hand's joints, as in `Sample.hand_joints`; empty at most frames.</summary>
        public double[] Joints = NoJoints;

        public static readonly double[] NoJoints = new double[0];

        /// <summary>True when the pose is measured.</summary>
        public bool IsTracked { get { return IsPresent && HasPose && Validity == PoseValidity.Measured; } }

        /// <summary>The device is gone: it is reported where it was, as not seen.</summary>
        public void Clear()
        {
            Validity = PoseValidity.NotSeen;
            HasRay = HasTip = false;
            Trigger = Squeeze = 0;
            Buttons = 0;
            Joints = NoJoints;
        }
    }

    /// <summary>A headset at one frame. Made once and filled again.</summary>
    public sealed class HeadsetReading
    {
        /// <summary>When it was sampled, on a monotonic clock, not when it will be displayed [ns].</summary>
        public long CaptureNs;

        /// <summary>`T_tracking_head`. Without one it was never seen.</summary>
        public RigidTransform Head;
        public bool HasHead;
        public PoseValidity HeadValidity;

        /// <summary>Where the eyes look: `T_tracking_gaze`, along x.</summary>
        public RigidTransform Gaze;
        public bool HasGaze;
        public PoseValidity GazeValidity;

        /// <summary>Left and right, by <see cref="Side"/>.</summary>
        public readonly InputReading[] Inputs = { new InputReading(), new InputReading() };

        public InputReading this[Side side] { get { return Inputs[(int)side]; } }
    }

    /// <summary>Pinch and fist of a bare hand.</summary>
    public static class Gestures
    {
        /// <summary>Distances between the tips of thumb and index finger of a closed and of an open pinch [m].</summary>
        private const double PinchClosedM = 0.015;
        private const double PinchOpenM = 0.045;

        /// <summary>The same for a fist: from the wrist to the tip of the middle finger, in lengths from the wrist to its knuckle.</summary>
        private const double FistClosed = 1.0;
        private const double FistOpen = 1.4;

        /// <summary>Return how far a hand pinches, 0 to 1. Positions in any one frame [m].</summary>
        public static double Pinch(Double3 thumbTip, Double3 indexTip)
        {
            return Closedness((thumbTip - indexTip).Length, PinchClosedM, PinchOpenM);
        }

        /// <summary>Return how far a hand is a fist, 0 to 1.</summary>
        public static double Fist(Double3 wrist, Double3 middleKnuckle, Double3 middleTip)
        {
            double palm = (wrist - middleKnuckle).Length;
            return palm > 0 ? Closedness((wrist - middleTip).Length / palm, FistClosed, FistOpen) : 0;
        }

        private static double Closedness(double value, double closed, double open)
        {
            return Math.Min(1, Math.Max(0, (open - value) / (open - closed)));
        }
    }
}
