using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Transport
{
    /// <summary>What a call of the engine is.</summary>
    internal enum CallKind
    {
        Action,
        Request,
        Sample,
        Sighting,
    }

    /// <summary>A call of the engine on its way to the thread of the session. Made once and filled again.</summary>
    internal sealed class SessionCall
    {
        private static readonly double[] Nothing = new double[0];
        private double[] twist = Nothing;
        private double[] handJoints = Nothing;
        private double[] q = Nothing;
        private double[] qd = Nothing;
        public readonly SampleInput Sample = new SampleInput();
        public readonly SheetSighting Sighting = new SheetSighting();

        public CallKind Kind { get; private set; }

        public Action<SessionLoop> Action { get; private set; }

        public ClientMessage Message { get; private set; }

        public long Ticket { get; private set; }

        public void SetAction(Action<SessionLoop> action)
        {
            Kind = CallKind.Action;
            Action = action;
        }

        public void SetRequest(ClientMessage message, long ticket)
        {
            Kind = CallKind.Request;
            Message = message;
            Ticket = ticket;
        }

        public void SetSample(SampleInput input)
        {
            Kind = CallKind.Sample;
            Sample.Device = input.Device;
            Sample.CaptureNs = input.CaptureNs;
            Sample.Pose = input.Pose;
            Sample.HasPose = input.HasPose;
            Sample.Validity = input.Validity;
            Sample.Clutch = input.Clutch;
            Sample.Gripper = input.Gripper;
            Sample.Buttons = input.Buttons;
            Sample.Kind = input.Kind;
            Copy(input.Robots, Sample.Robots);
            Copy(input.Objects, Sample.Objects);
            Sample.Twist = Copy(input.Twist, ref twist);
            Sample.HandJoints = Copy(input.HandJoints, ref handJoints);
            Sample.Q = Copy(input.Q, ref q);
            Sample.Qd = Copy(input.Qd, ref qd);
        }

        public void SetSighting(SheetSighting sighting)
        {
            Kind = CallKind.Sighting;
            Sighting.AnchorId = sighting.AnchorId;
            Sighting.T_tracking_anchor = sighting.T_tracking_anchor;
            Sighting.Alternative = sighting.Alternative;
            Sighting.HasAlternative = sighting.HasAlternative;
            Sighting.ResidualPx = sighting.ResidualPx;
            Sighting.AlternativeResidualPx = sighting.AlternativeResidualPx;
            Sighting.CaptureNs = sighting.CaptureNs;
            Sighting.SizeM = sighting.SizeM;
            Sighting.T_tracking_camera = sighting.T_tracking_camera;
            Sighting.Source = sighting.Source;
            Sighting.IsSeen = sighting.IsSeen;
        }

        /// <summary>Let go of objects of the application.</summary>
        public void Clear()
        {
            Action = null;
            Message = null;
        }

        private static void Copy(List<string> from, List<string> to)
        {
            to.Clear();
            for (int i = 0; i < from.Count; i++) to.Add(from[i]);
        }

        /// <summary>Copy into an array that is kept. Most samples have no joints: those leave it as it is.</summary>
        private static double[] Copy(double[] from, ref double[] kept)
        {
            if (from == null) return null;
            if (from.Length == 0) return Nothing;
            if (kept.Length != from.Length) kept = new double[from.Length];
            Array.Copy(from, kept, from.Length);
            return kept;
        }
    }
}
