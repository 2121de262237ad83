// A place before the eyes for something that is read: it stays where it appeared, and comes back when the head has turned away.
using System;
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Where such a panel is, in the tracking frame. For one thread.</summary>
    public sealed class BeforeEyes
    {
        /// <summary>What is farther than this from where it appeared in the view comes back before the eyes [rad].</summary>
        private const double MaxOff = 0.7;

        private readonly double distanceM;
        private readonly double above;

        /// <param name="distanceM">From the eyes [m].</param>
        /// <param name="above">Angle above the middle of the view [rad].</param>
        public BeforeEyes(double distanceM, double above)
        {
            this.distanceM = distanceM;
            this.above = above;
        }

        /// <summary>False before the first head pose, and after <see cref="Hide"/>.</summary>
        public bool IsPlaced { get; private set; }

        public Double3 At { get; private set; }

        /// <summary>To the left of one who reads it, and upwards. Unit vectors.</summary>
        public Double3 Left { get; private set; }

        public Double3 Up { get; private set; }

        /// <summary>When it came to where it is now [ns].</summary>
        public long SinceNs { get; private set; }

        /// <summary>Take a frame.</summary>
        public void Update(HeadsetReading reading)
        {
            if (!reading.HasHead || (IsPlaced && IsInView(reading.Head))) return;
            RigidTransform head = reading.Head;
            At = head.Position + distanceM * FindDirection(head);
            Left = head.Rotation.Rotate(new Double3(0, 1, 0));
            Up = head.Rotation.Rotate(new Double3(-Math.Sin(above), 0, Math.Cos(above)));
            IsPlaced = true;
            SinceNs = reading.CaptureNs;
        }

        /// <summary>Nothing is shown any more: the next time it appears before the eyes.</summary>
        public void Hide()
        {
            IsPlaced = false;
        }

        private bool IsInView(RigidTransform head)
        {
            Double3 offset = At - head.Position;
            return Double3.Dot(offset, FindDirection(head)) > Math.Cos(MaxOff) * offset.Length;
        }

        private Double3 FindDirection(RigidTransform head)
        {
            return head.Rotation.Rotate(new Double3(Math.Cos(above), 0, Math.Sin(above)));
        }
    }
}
