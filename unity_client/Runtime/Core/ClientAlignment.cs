// Our alignment: how the tracking frame lies in the world, and what we report so that the session can estimate it.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>What a person has to know of its alignment.</summary>
    public enum AlignmentState
    {
        /// <summary>No alignment in the present tracking frame: look at a sheet.</summary>
        None,

        /// <summary>Good enough to look, not to drive: fingertip, or a place that the device kept.</summary>
        Provisional,

        /// <summary>Measured, placed by a director, or not needed.</summary>
        Aligned,
    }

    /// <summary>One sheet as the headset sees it, in the tracking frame and the axes of the wire. Made once and filled again.</summary>
    public sealed class SheetSighting
    {
        public string AnchorId = "";
        public RigidTransform T_tracking_anchor;

        /// <summary>The other pose that explains the picture, if the runtime knows it; see <see cref="HasAlternative"/>.</summary>
        public RigidTransform Alternative;
        public bool HasAlternative;

        /// <summary>Root mean squares of the residuals of both poses [px]; 0 where they are not known.</summary>
        public double ResidualPx;
        public double AlternativeResidualPx;

        /// <summary>Session time of the picture [ns].</summary>
        public long CaptureNs;

        /// <summary>Edge of the sheet as the runtime measures it [m].</summary>
        public double SizeM;

        /// <summary>Head or camera at that time, which tells viewpoints apart.</summary>
        public RigidTransform T_tracking_camera;

        /// <summary>An `ObservationSource`.</summary>
        public string Source = ObservationSource.QrSystem;

        /// <summary>False for a marker that the runtime remembers and does not see.</summary>
        public bool IsSeen = true;
    }

    /// <summary>A tip or fingertip at rest on a point.</summary>
    public sealed class TouchReport
    {
        /// <summary>The sheet, or the name of a point that others touch too.</summary>
        public string AnchorId = "";

        /// <summary>Mark of the sheet, empty for its origin. Null: a point that others touch too.</summary>
        public string Mark;
        public string Device = "";

        /// <summary>Position of the tip, rotation of the device.</summary>
        public RigidTransform T_tracking_tip;

        /// <summary>Session time [ns].</summary>
        public long CaptureNs;

        /// <summary>6x6 row-major [m], [rad]; empty: as the session has it for such a device.</summary>
        public double[] Covariance = Array.Empty<double>();
    }

    /// <summary>Reports observations of one connection, and says how it is aligned.</summary>
    public sealed class ClientAlignment
    {
        /// <summary>Poses of a tip that are sent at most.</summary>
        private const int MaxTipPoses = 100;

        /// <summary>Markers nearer to the origin of the tracking frame than this are none: runtimes report it for what they have not located [m].</summary>
        private const double OriginM = 1e-6;

        private readonly ClientConnection connection;
        private readonly ViewpointCounter viewpoints = new ViewpointCounter();

        public ClientAlignment(ClientConnection connection)
        {
            this.connection = connection;
        }

        /// <summary>Sightings that were not sent: not seen, at the origin, without a size, not finite, not connected.</summary>
        public long Ignored { get; private set; }

        /// <summary>Our own `T_world_tracking` as accepted by the session, null before. One of an earlier tracking frame is void.</summary>
        public Alignment Current
        {
            get
            {
                Alignment alignment = connection.Mirror.FindAlignment(connection.ParticipantId);
                return alignment == null || alignment.TrackingEpoch != connection.TrackingEpoch ? null : alignment;
            }
        }

        public AlignmentState State
        {
            get
            {
                Alignment alignment = Current;
                if (alignment == null || alignment.Kind == AlignmentKind.None) return AlignmentState.None;
                bool isProvisional = alignment.Kind == AlignmentKind.Fingertip || alignment.Kind == AlignmentKind.Persistent;
                return isProvisional ? AlignmentState.Provisional : AlignmentState.Aligned;
            }
        }

        /// <summary>Return `T_world_tracking`; false without an alignment.</summary>
        public bool TryGetTransform(out RigidTransform T_world_tracking)
        {
            Alignment alignment = Current;
            T_world_tracking = alignment == null ? RigidTransform.Identity : ToTransform(alignment.T_world_tracking);
            return alignment != null && alignment.Kind != AlignmentKind.None;
        }

        /// <summary>Report a sheet. What the runtime only remembers, or has not located, is counted and not sent.</summary>
        /// <returns>Whether it was queued.</returns>
        public bool Observe(SheetSighting sighting)
        {
            bool isUsable = sighting.IsSeen && sighting.SizeM > 0 && sighting.SizeM < 10 && IsUsable(sighting.T_tracking_anchor) && connection.IsJoined;
            if (!isUsable)
            {
                Ignored++;
                return false;
            }
            Observation observation = new Observation
            {
                AnchorId = sighting.AnchorId,
                Kind = AnchorKind.Qr,
                T_tracking_anchor = ToPose(sighting.T_tracking_anchor),
                CaptureNs = sighting.CaptureNs,
                TrackingEpoch = connection.TrackingEpoch,
                ViewpointId = viewpoints.NumberAt(connection.TrackingEpoch, sighting.T_tracking_camera),
                SizeM = sighting.SizeM,
                Source = sighting.Source,
            };
            if (sighting.HasAlternative)
            {
                observation.Alternative = ToPose(sighting.Alternative);
                if (sighting.ResidualPx > 0) observation.ResidualsPx = new[] { sighting.ResidualPx, sighting.AlternativeResidualPx };
            }
            return connection.Send(observation);
        }

        /// <summary>Report that a tip is on a mark of a sheet, or on a point that others touch too.</summary>
        /// <returns>Whether it was queued.</returns>
        public bool ReportTouch(TouchReport touch)
        {
            if (!IsUsable(touch.T_tracking_tip) || !connection.IsJoined)
            {
                Ignored++;
                return false;
            }
            return connection.Send(new Observation
            {
                AnchorId = touch.AnchorId,
                Kind = touch.Mark == null ? AnchorKind.Point : AnchorKind.Touch,
                T_tracking_anchor = ToPose(touch.T_tracking_tip),
                CaptureNs = touch.CaptureNs,
                TrackingEpoch = connection.TrackingEpoch,
                Device = touch.Device,
                Mark = touch.Mark ?? "",
                Covariance = touch.Covariance,
            });
        }

        /// <summary>Report poses `T_tracking_grip` of a controller that was turned while its tip stayed in a hole. Of more than 100, 100 are sent.</summary>
        /// <returns>Whether they were queued. The session answers with the event `tip_calibrated`.</returns>
        public bool ReportTipPoses(string device, RigidTransform[] T_tracking_grip, long captureNs)
        {
            if (!connection.IsJoined || T_tracking_grip.Length == 0) return false;
            int kept = Math.Min(T_tracking_grip.Length, MaxTipPoses);
            Pose[] poses = new Pose[kept];
            for (int k = 0; k < kept; k++) poses[k] = ToPose(T_tracking_grip[(int)((long)k * T_tracking_grip.Length / kept)]);
            return connection.Send(new Observation
            {
                Kind = AnchorKind.Tip,
                T_tracking_anchor = ToPose(RigidTransform.Identity),
                CaptureNs = captureNs,
                TrackingEpoch = connection.TrackingEpoch,
                Device = device,
                GripPoses = poses,
            });
        }

        /// <summary>Measure our alignment again from the beginning. The one in force stays until there is a better one. Returns the request.</summary>
        public long StartRun()
        {
            return connection.Request(new Align { Action = AlignAction.Start, Participant = connection.ParticipantId });
        }

        /// <summary>Stop the measurement, and keep the alignment in force. Returns the request.</summary>
        public long StopRun()
        {
            return connection.Request(new Align { Action = AlignAction.Stop, Participant = connection.ParticipantId });
        }

        internal static RigidTransform ToTransform(Pose pose)
        {
            return new RigidTransform(
                new Double3(pose.P[0], pose.P[1], pose.P[2]),
                new DoubleQuaternion(pose.Q[0], pose.Q[1], pose.Q[2], pose.Q[3]));
        }

        private static Pose ToPose(RigidTransform transform)
        {
            Pose pose = new Pose();
            SampleBuilder.WritePose(transform, pose);
            return pose;
        }

        private static bool IsUsable(RigidTransform pose)
        {
            double distance = pose.Position.Length;
            DoubleQuaternion q = pose.Rotation;
            double norm = q.W * q.W + q.X * q.X + q.Y * q.Y + q.Z * q.Z;
            return distance > OriginM && distance < 1e6 && Math.Abs(norm - 1.0) < 1e-3;
        }
    }

    /// <summary>Numbers viewpoints: observations from one place share their systematic error.</summary>
    internal sealed class ViewpointCounter
    {
        private const double ViewpointM = 0.15; // from further away, or after such a turn, the errors of lens and light are others
        private const double ViewpointRad = 0.26;

        private long number;
        private long epoch = -1;
        private RigidTransform from;

        /// <summary>Return the number of the viewpoint of a pose.</summary>
        public long NumberAt(long trackingEpoch, RigidTransform T_tracking_camera)
        {
            bool isSame = trackingEpoch == epoch
                && (T_tracking_camera.Position - from.Position).Length <= ViewpointM
                && DoubleQuaternion.Angle(T_tracking_camera.Rotation, from.Rotation) <= ViewpointRad;
            if (isSame) return number;
            number++;
            epoch = trackingEpoch;
            from = T_tracking_camera;
            return number;
        }
    }
}
