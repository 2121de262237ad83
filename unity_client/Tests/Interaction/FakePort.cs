// A session, a scene and devices for tests: what is asked of them is kept.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction.Tests
{
    public sealed class FakePort : ISessionPort
    {
        public const long SessionOffset = 5_000_000_000;
        public readonly List<ClientMessage> Requests = new List<ClientMessage>();
        public readonly List<SampleInput> Samples = new List<SampleInput>();
        public readonly List<TouchReport> Touches = new List<TouchReport>();
        public readonly List<RigidTransform[]> TipPoses = new List<RigidTransform[]>();
        public readonly List<SheetSighting> Looks = new List<SheetSighting>();
        public readonly List<string> Stops = new List<string>();
        public readonly Dictionary<string, Lease> LeaseTable = new Dictionary<string, Lease>();
        public readonly Dictionary<string, AnchorInfo> AnchorTable = new Dictionary<string, AnchorInfo>();
        public readonly Dictionary<string, RobotInfo> RobotTable = new Dictionary<string, RobotInfo>();
        public readonly Dictionary<string, ParticipantInfo> PeopleTable = new Dictionary<string, ParticipantInfo>();
        public RigidTransform? T_world_tracking = RigidTransform.Identity;
        public int Recentred;
        public bool KeepsSamples = true;

        public FakePort()
        {
            PeopleTable["p1"] = new ParticipantInfo { Id = "p1", Name = "ann", Role = Role.Operator };
            RobotTable["left"] = new RobotInfo { Name = "left", BaseBody = 1, SiteBody = 3 };
            RobotTable["right"] = new RobotInfo { Name = "right", BaseBody = 11, SiteBody = 13 };
            foreach (string robot in RobotTable.Keys) LeaseTable[robot] = new Lease { Target = robot, Kind = TargetKind.Robot, Mode = LeaseMode.Exclusive, LeaseVersion = 4 };
            AnchorTable["table"] = new AnchorInfo { Id = "table", T_world_anchor = new Pose { P = new[] { 0.7, 0, 0.8 }, Q = new[] { 1.0, 0, 0, 0 } }, SizeM = 0.15 };
        }

        public bool IsJoined { get; set; } = true;

        public string SessionId { get; set; } = "s1";

        public string ParticipantId { get { return "p1"; } }

        public long SceneEpoch { get; set; }

        public bool IsStopped { get; set; }

        public long ConsentTimeoutNs { get; set; }

        public EpisodeChanged Episode { get; set; }

        public IReadOnlyDictionary<string, ParticipantInfo> Participants { get { return PeopleTable; } }

        public IReadOnlyDictionary<string, Lease> Leases { get { return LeaseTable; } }

        public IReadOnlyDictionary<string, RobotInfo> Robots { get { return RobotTable; } }

        public IReadOnlyDictionary<string, AnchorInfo> Anchors { get { return AnchorTable; } }

        public AlignmentState AlignmentState { get { return T_world_tracking.HasValue ? AlignmentState.Aligned : AlignmentState.None; } }

        public bool HasClock { get; set; } = true;

        public bool TryGetAlignment(out RigidTransform transform)
        {
            transform = T_world_tracking ?? RigidTransform.Identity;
            return T_world_tracking.HasValue;
        }

        public long ToSessionNs(long localNs) { return localNs + SessionOffset; }

        public bool TrySendSample(SampleInput input)
        {
            if (!KeepsSamples) return true;
            SampleInput copy = new SampleInput { Device = input.Device, CaptureNs = input.CaptureNs, Pose = input.Pose, Validity = input.Validity, Clutch = input.Clutch, Gripper = input.Gripper, Buttons = input.Buttons };
            copy.Robots.AddRange(input.Robots);
            Samples.Add(copy);
            return true;
        }

        public bool TryObserve(SheetSighting sighting)
        {
            Looks.Add(new SheetSighting { AnchorId = sighting.AnchorId, CaptureNs = sighting.CaptureNs, SizeM = sighting.SizeM, T_tracking_anchor = sighting.T_tracking_anchor, T_tracking_camera = sighting.T_tracking_camera, Source = sighting.Source });
            return true;
        }

        public void ReportTouch(TouchReport touch) { Touches.Add(touch); }

        public void ReportTipPoses(string device, RigidTransform[] T_tracking_grip, long captureNs) { TipPoses.Add(T_tracking_grip); }

        public long Request(ClientMessage message)
        {
            Requests.Add(message);
            return Requests.Count;
        }

        public bool EStop(string reason)
        {
            Stops.Add(reason);
            return true;
        }

        public void ReportRecentred() { Recentred++; }

        /// <summary>Return the newest sample of a device.</summary>
        public SampleInput Find(string device)
        {
            for (int i = Samples.Count - 1; i >= 0; i--) if (Samples[i].Device == device) return Samples[i];
            return null;
        }

        public void Give(string robot, string holder, long version = 5)
        {
            LeaseTable[robot] = new Lease { Target = robot, Kind = TargetKind.Robot, Mode = LeaseTable[robot].Mode, Holder = holder, LeaseVersion = version };
        }
    }

    /// <summary>Two arms of three links, each 0.3 m long and upright: left at y = 0.3, right at y = -0.3, one metre ahead.</summary>
    public sealed class FakeBodies : IBodies
    {
        /// <summary>0: the plan of the scene is still to come.</summary>
        public long Version { get; set; } = 1;

        public long FindParent(long body) { return Version > 0 && body % 10 > 1 ? body - 1 : 0; }

        public bool TryGetPosition(long body, out Double3 p_world_body)
        {
            p_world_body = new Double3(1.0, body > 10 ? -0.3 : 0.3, 0.8 + 0.3 * (body % 10 - 1));
            return true;
        }
    }

    public sealed class FakeHaptics : IHaptics
    {
        public readonly List<KeyValuePair<Side, Pulse>> Played = new List<KeyValuePair<Side, Pulse>>();

        public void Play(Side side, Pulse pulse) { Played.Add(new KeyValuePair<Side, Pulse>(side, pulse)); }
    }

    public sealed class FakeMarkers : IMarkerSource
    {
        public readonly List<MarkerReport> Now = new List<MarkerReport>();
        public bool IsActive;

        public MarkerSupport Support { get { return MarkerSupport.Ready; } }

        public string Source { get { return ObservationSource.QrSystem; } }

        public int Read(List<MarkerReport> reports)
        {
            reports.Clear();
            reports.AddRange(Now);
            return Now.Count;
        }

        public void SetActive(bool isActive) { IsActive = isActive; }
    }

    /// <summary>A headset whose wearer holds two controllers and points at the robots with them.</summary>
    public sealed class Wearer
    {
        public const long FrameNs = 14_000_000;
        public readonly FakePort Session = new FakePort();
        public readonly FakeBodies Bodies = new FakeBodies();
        public readonly FakeHaptics Haptics = new FakeHaptics();
        public readonly HeadsetInput Input;
        public bool IsLive = true;
        public int Suspensions;

        public Wearer()
        {
            Input = new HeadsetInput(Session, Bodies, Haptics);
            Input.Reading.HasHead = true;
            Input.Reading.Head = new RigidTransform(new Double3(0, 0, 1.6), DoubleQuaternion.Identity);
            Input.Reading.HeadValidity = PoseValidity.Measured;
            for (int side = 0; side < 2; side++)
            {
                InputReading hand = Input.Reading.Inputs[side];
                hand.IsPresent = hand.HasPose = hand.HasRay = true;
                hand.Validity = PoseValidity.Measured;
                PointAhead((Side)side);
            }
        }

        public InputReading this[Side side] { get { return Input.Reading[side]; } }

        /// <summary>Let a hand point at the robot of its side.</summary>
        public void PointAhead(Side side)
        {
            Double3 at = new Double3(0.2, side == Side.Left ? 0.3 : -0.3, 1.1);
            this[side].Pose = new RigidTransform(at, DoubleQuaternion.Identity);
            this[side].Ray = new AimRay(at, new Double3(1, 0, 0));
        }

        /// <summary>Let a hand point at nothing.</summary>
        public void PointUp(Side side)
        {
            this[side].Ray = new AimRay(this[side].Pose.Position, new Double3(0, 0, 1));
        }

        public void Run(int frames = 1)
        {
            for (int i = 0; i < frames; i++)
            {
                Input.Reading.CaptureNs += FrameNs;
                Input.Update(IsLive, Suspensions);
            }
        }

        public void RunFor(long ns) { Run((int)(ns / FrameNs) + 1); }

        /// <summary>Press and let go.</summary>
        public void Tap(Side side)
        {
            this[side].Trigger = 1;
            Run();
            this[side].Trigger = 0;
            Run();
        }

        public void PressButton(Side side, long bit)
        {
            this[side].Buttons = bit;
            Run();
            this[side].Buttons = 0;
            Run();
        }

        /// <summary>Take a robot by pointing, with the answer of the session.</summary>
        public void Take(Side side, string robot)
        {
            Run();
            Tap(side);
            Session.Give(robot, "p1");
            Input.TakeReply(Session.Requests.Count, new Reply { Ok = true }, Input.Reading.CaptureNs);
            Run(10);
        }
    }
}
