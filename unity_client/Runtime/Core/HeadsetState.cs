// What the runtime of a headset reports beside poses: worn or not, covered or in the background, recentred, tracking lost, permissions.
//
// It is the one place that decides what a report does:
//
//     report                    | worn  | tracking epoch | clutches             | samples
//     --------------------------+-------+----------------+----------------------+-----------------------------------------
//     taken off                 | false | -              | open until let go    | not tracked, where they were
//     app in the background     | false | -              | open until let go    | not tracked, where they were
//     covered by a menu         | -     | -              | open until let go    | not tracked, where they were
//     recentred                 | -     | + 1            | open until let go    | as measured, in the new frame
//     tracking of the head lost | -     | -              | open until let go    | not tracked, where they were
//     tracking of a device lost | -     | -              | its own, until let go| not tracked, where it was
//     its position is a guess   | -     | -              | its own, until let go| emulated
//     permission for hands gone | -     | -              | of hands             | hands are not tracked
//
// The session ends engagements by the same samples, so robots hold at once and never follow a pose that was not measured.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Where the app is on the headset.</summary>
    public enum AppFocus
    {
        /// <summary>Seen, and input reaches it (OpenXR: focused).</summary>
        Focused,

        /// <summary>Seen, but a menu of the system has the input (OpenXR: visible).</summary>
        Covered,

        /// <summary>Not seen (paused; OpenXR: synchronized or less).</summary>
        Background,
    }

    /// <summary>What a headset asks its wearer for.</summary>
    public enum HeadsetPermission
    {
        /// <summary>Pictures of the cameras: sheets that the app finds itself.</summary>
        Camera,

        /// <summary>What the system knows of the room: sheets that it finds.</summary>
        Scene,
        Hands,
    }

    /// <summary>Answer of the wearer.</summary>
    public enum PermissionState
    {
        /// <summary>Not asked yet, or not needed on this headset.</summary>
        Unknown,
        Granted,
        Denied,
    }

    /// <summary>A change that a person may have to know of.</summary>
    public enum HeadsetEvent
    {
        PutOn,
        TakenOff,
        Focused,
        Covered,
        Background,
        Recentred,
        TrackingLost,
        TrackingFound,
        PermissionGranted,
        PermissionDenied,
    }

    /// <summary>State of the headset, and what it makes of samples. For the thread of the connection.</summary>
    public sealed class HeadsetState
    {
        private const int MaxEvents = 32;

        /// <summary>Floats of a pose at the origin of its frame, without a turn: the zero of some runtimes before they have a pose.</summary>
        private const double ZeroTolerance = 1e-6;
        private static readonly double[] NoJoints = new double[0];

        private sealed class DeviceState
        {
            public RigidTransform Pose = RigidTransform.Identity;
            public bool HasPose;

            /// <summary>The clutch was closed when it was suspended, and has not been opened since.</summary>
            public bool MustLetGo;
            public bool IsClutched;
        }

        private readonly ClientConnection connection;
        private readonly Dictionary<string, DeviceState> devices = new Dictionary<string, DeviceState>();
        private readonly Queue<HeadsetEvent> events = new Queue<HeadsetEvent>();
        private readonly PermissionState[] permissions = new PermissionState[3];
        private readonly HashSet<string> guessed = new HashSet<string>();
        private bool isOnHead = true;

        public HeadsetState(ClientConnection connection)
        {
            this.connection = connection;
        }

        public AppFocus Focus { get; private set; } = AppFocus.Focused;

        /// <summary>True while the runtime locates the head.</summary>
        public bool IsTracking { get; private set; } = true;

        /// <summary>True while the person sees the scene, and their input reaches it.</summary>
        public bool IsLive { get { return isOnHead && Focus == AppFocus.Focused && IsTracking; } }

        /// <summary>Poses that no device can have: not finite, or zero before there is one. They were reported as not seen.</summary>
        public long ImplausiblePoses { get; private set; }

        /// <summary>Events that nothing took.</summary>
        public long DroppedEvents { get; private set; }

        /// <summary>Counts what opens all clutches: buttons that are held count from their next press when it has grown.</summary>
        public int Suspensions { get; private set; }

        public PermissionState this[HeadsetPermission permission] { get { return permissions[(int)permission]; } }

        /// <summary>False on a headset that finds no sheets by itself, as its system says.</summary>
        public bool HasMarkerSupport { get; set; } = true;

        /// <summary>False when the wearer was asked for a way in which sheets are found, and has allowed none.</summary>
        public bool CanSeeSheets
        {
            get
            {
                PermissionState camera = this[HeadsetPermission.Camera], scene = this[HeadsetPermission.Scene];
                bool isDenied = camera == PermissionState.Denied || scene == PermissionState.Denied;
                return !isDenied || camera == PermissionState.Granted || scene == PermissionState.Granted;
            }
        }

        /// <summary>The headset was put on or taken off.</summary>
        public void SetOnHead(bool isOnHead)
        {
            if (isOnHead == this.isOnHead) return;
            this.isOnHead = isOnHead;
            ApplyWorn(isOnHead ? HeadsetEvent.PutOn : HeadsetEvent.TakenOff);
        }

        /// <summary>The app came to the front, was covered, or went to the background.</summary>
        public void SetFocus(AppFocus focus)
        {
            if (focus == Focus) return;
            Focus = focus;
            ApplyWorn(focus == AppFocus.Focused ? HeadsetEvent.Focused : focus == AppFocus.Covered ? HeadsetEvent.Covered : HeadsetEvent.Background);
        }

        /// <summary>
        /// The tracking frame has moved: the wearer recentred, or the runtime located itself anew. Call it before anything is sent that was
        /// measured in the new frame. The alignment is void until the next look at a sheet.
        /// </summary>
        public void OnRecentred()
        {
            connection.ReportTrackingJump();
            foreach (DeviceState device in devices.Values) device.HasPose = false; // those are of the old frame
            Suspend(HeadsetEvent.Recentred);
        }

        /// <summary>The runtime locates the head, or does not.</summary>
        public void SetTracking(bool isTracking)
        {
            if (isTracking == IsTracking) return;
            IsTracking = isTracking;
            Suspend(isTracking ? HeadsetEvent.TrackingFound : HeadsetEvent.TrackingLost);
        }

        /// <summary>The wearer has answered, or changed the settings.</summary>
        public void SetPermission(HeadsetPermission permission, bool isGranted)
        {
            PermissionState state = isGranted ? PermissionState.Granted : PermissionState.Denied;
            if (permissions[(int)permission] == state) return;
            permissions[(int)permission] = state;
            AddEvent(isGranted ? HeadsetEvent.PermissionGranted : HeadsetEvent.PermissionDenied);
        }

        /// <summary>Take feedback of a robot: a sample of a guessed pose names it only until the session says that it holds for that.</summary>
        public void TakeFeedback(Feedback feedback)
        {
            if (feedback.HoldReason == HoldReason.Emulated && guessed.Count < 1024) guessed.Add(feedback.Robot);
            else guessed.Remove(feedback.Robot);
        }

        /// <summary>Remove the oldest event. False when there is none.</summary>
        public bool TryTakeEvent(out HeadsetEvent one)
        {
            bool hasEvent = events.Count > 0;
            one = hasEvent ? events.Dequeue() : default;
            return hasEvent;
        }

        /// <summary>
        /// Make of an input what may be sent: validity, clutch, buttons, joints. `Pose`, `Validity` and `Clutch` are as the runtime says
        /// them, of the grip and not of what is drawn.
        /// </summary>
        /// <returns>False when there is nothing to send: the device has had no pose in this tracking frame.</returns>
        public bool Judge(SampleInput input)
        {
            if (!devices.TryGetValue(input.Device, out DeviceState device)) devices[input.Device] = device = new DeviceState { MustLetGo = input.Clutch };
            bool isHand = input.Device == Device.HandLeft || input.Device == Device.HandRight;
            if (!IsLive || (isHand && this[HeadsetPermission.Hands] == PermissionState.Denied)) input.Validity = PoseValidity.NotSeen;
            if (input.HasPose) JudgePose(input, device);
            JudgeClutch(input, device);
            if (input.Validity == PoseValidity.NotSeen)
            {
                input.HandJoints = NoJoints;
                input.Twist = null;
                if (!IsLive) input.Buttons = 0; // a menu has them
            }
            for (int i = input.Robots.Count - 1; i >= 0 && input.Validity == PoseValidity.Emulated; i--)
            {
                if (guessed.Contains(input.Robots[i])) input.Robots.RemoveAt(i);
            }
            return !input.HasPose || device.HasPose;
        }

        private void JudgePose(SampleInput input, DeviceState device)
        {
            if (input.Validity != PoseValidity.NotSeen && !IsPlausible(input.Pose))
            {
                ImplausiblePoses++;
                input.Validity = PoseValidity.NotSeen;
            }
            if (input.Validity == PoseValidity.NotSeen)
            {
                input.Pose = device.Pose;
                return;
            }
            input.Pose = new RigidTransform(input.Pose.Position, input.Pose.Rotation.Normalized);
            device.Pose = input.Pose;
            device.HasPose = true;
        }

        private static void JudgeClutch(SampleInput input, DeviceState device)
        {
            if (!input.Clutch) device.MustLetGo = false;
            else if (input.Validity != PoseValidity.Measured) device.MustLetGo = true;
            device.IsClutched = input.Clutch && !device.MustLetGo;
            input.Clutch = device.IsClutched;
            if (!device.IsClutched) input.Gripper = null;
        }

        private static bool IsPlausible(RigidTransform pose)
        {
            Double3 p = pose.Position;
            DoubleQuaternion q = pose.Rotation;
            double sum = p.X + p.Y + p.Z;
            double norm = q.W * q.W + q.X * q.X + q.Y * q.Y + q.Z * q.Z;
            if (double.IsNaN(sum) || double.IsInfinity(sum) || !(norm > 0.25 && norm < 4.0)) return false;
            double turn = Math.Max(Math.Abs(q.X), Math.Max(Math.Abs(q.Y), Math.Abs(q.Z)));
            return p.Length > ZeroTolerance || turn > ZeroTolerance;
        }

        private void ApplyWorn(HeadsetEvent one)
        {
            connection.SetWorn(isOnHead && Focus != AppFocus.Background);
            Suspend(one);
        }

        private void Suspend(HeadsetEvent one)
        {
            Suspensions++;
            foreach (DeviceState device in devices.Values) device.MustLetGo = true;
            AddEvent(one);
        }

        private void AddEvent(HeadsetEvent one)
        {
            events.Enqueue(one);
            if (events.Count <= MaxEvents) return;
            events.Dequeue();
            DroppedEvents++;
        }
    }
}
