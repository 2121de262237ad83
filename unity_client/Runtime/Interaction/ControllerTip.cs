// The tip of a controller: poses for its calibration, and what the session made of them.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>A tip as the session calibrated it, in the frame of its controller.</summary>
    public sealed class ControllerTip
    {
        // Noise of a touch per axis [m], [rad], as docs/protocol.md (section 5) has it.
        private const double TouchSigmaM = 0.0015;
        private const double TouchSigmaRad = 0.01;

        private readonly double varianceM2;

        public ControllerTip(TipCalibrated answer)
        {
            Position = new Double3(answer.PGripTip[0], answer.PGripTip[1], answer.PGripTip[2]);
            double[] c = answer.Covariance;
            varianceM2 = c.Length == 9 ? c[0] + c[4] + c[8] : 0;
        }

        public Double3 Position { get; }

        /// <summary>Return the covariance of a touch, with that of the tip: a session that has forgotten the tip takes the touch for what it is.</summary>
        public double[] MakeTouchCovariance()
        {
            double[] covariance = new double[36];
            for (int axis = 0; axis < 6; axis++)
                covariance[7 * axis] = axis < 3 ? TouchSigmaM * TouchSigmaM + varianceM2 : TouchSigmaRad * TouchSigmaRad;
            return covariance;
        }
    }

    /// <summary>Different turns of a controller whose tip stays in a hole.</summary>
    public sealed class TipTurns
    {
        /// <summary>Orientations of a calibration, and the angle between any two of them [rad]: together a cone of more than 20 degrees.</summary>
        public const int Enough = 80;
        private const double StepRad = 5 * Math.PI / 180;

        /// <summary>The session wants at least so many.</summary>
        public const int Least = 20;

        private readonly List<RigidTransform> poses = new List<RigidTransform>(Enough);

        public int Count { get { return poses.Count; } }

        public void Clear() { poses.Clear(); }

        /// <summary>Keep a pose `T_tracking_device` that is turned otherwise than all that are kept.</summary>
        public void Add(RigidTransform pose)
        {
            if (poses.Count >= Enough) return;
            foreach (RigidTransform one in poses) if (DoubleQuaternion.Angle(one.Rotation, pose.Rotation) < StepRad) return;
            poses.Add(pose);
        }

        public RigidTransform[] ToArray() { return poses.ToArray(); }
    }
}
