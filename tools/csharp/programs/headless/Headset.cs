using System;
using System.Collections.Generic;
using System.IO;
using System.Threading;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Storage;
using IrisSession.Transport;

/// <summary>A headset that is emulated: head and right controller in a tracking frame of its own, and a loop of frames at 72 Hz.</summary>
internal sealed class Headset : IDisposable
{
    public const int FrameMs = 14;
    private const long FreshNs = 100_000_000;
    private const long SilentNs = 10_000_000_000;
    private const double WalkingSpeed = 0.7; // m/s

    /// <summary>Where the tracking frame is: nothing about it is special.</summary>
    public static readonly RigidTransform T_world_tracking = new RigidTransform(
        new Double3(-0.4, 0.3, -0.75), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), 0.61));

    /// <summary>The newest session that was joined and its scene, null before.</summary>
    public SessionClient Client;
    public SceneFetcher Scene;

    /// <summary>Null for a session by ZeroMQ.</summary>
    public readonly SessionConnector Connector;
    public readonly List<SessionNews> News = new List<SessionNews>();

    /// <summary>Feedback of the robots that we hold, and the strongest vibration that a contact has made.</summary>
    public readonly FeedbackPulses Pulses = new FeedbackPulses();
    public Pulse ContactPulse;

    /// <summary>Samples that could not be sent, at the newest <see cref="CountUnsent"/>.</summary>
    public long Unsent;

    /// <summary>Ages of states when the frame took them [ms].</summary>
    public readonly List<double> Ages = new List<double>();

    /// <summary>Robots to drive, and whether the clutch is closed.</summary>
    public readonly List<string> Robots = new List<string>();
    public bool Clutch;
    public RigidTransform T_world_controller = new RigidTransform(new Double3(0.1, -0.2, 0.5), DoubleQuaternion.Identity);
    public RigidTransform T_world_head = new RigidTransform(new Double3(-0.6, 0.0, 0.6), DoubleQuaternion.Identity);
    public bool SendsSamples;

    /// <summary>Ctrl-C was pressed: nothing waits any more.</summary>
    public volatile bool IsInterrupted;

    /// <summary>Frames, states, the longest time of a frame's calls, and after the newest stand-still the time until the state was fresh again [ms].</summary>
    public int Frames;
    public int States;
    public double LongestCallMs;
    public double RecoveryMs = -1;
    private readonly Options options;
    private readonly Report report;
    private readonly long beganNs;
    private PairingResult pairing; // that was reported
    private ConnectorPhase phase;
    private string what = "";
    private readonly SampleInput head = new SampleInput { Device = Device.Head };
    private readonly SampleInput controller = new SampleInput { Device = Device.ControllerRight };
    private long frameNs;
    private long awakeNs = -1;

    public Headset(Options options, Report report)
    {
        this.options = options;
        this.report = report;
        string run = BitConverter.ToString(Guid.NewGuid().ToByteArray()).Replace("-", "").ToLowerInvariant();
        beganNs = MonotonicClock.NowNs;
        if (options.Zmq.Length > 0)
        {
            ConnectByZmq(run);
            return;
        }
        Connector = new SessionConnector(new ConnectorSettings
        {
            Role = options.RoleName,
            Name = options.Name,
            Software = "iris-session headless",
            Devices = SendsDevices ? new[] { Device.Head, Device.ControllerRight } : new string[0],
            Capabilities = new[] { "run:" + run },
            Identity = new FileIdentityStore(options.Identity),
            Cache = new AssetCache(new DiskAssetFiles(Path.Combine(options.Identity, "assets"))),
            Address = options.Address,
            PairingFile = options.PairingFile,
            SessionName = options.Session,
            UsesThisMachine = true,
        });
        if (options.Code.Length > 0) Connector.EnterCode(options.Code);
        Connector.Start();
    }

    /// <summary>True when there is a client.</summary>
    public bool IsRunning { get { return Connector == null || Connector.View.Phase == ConnectorPhase.Running; } }

    /// <summary>True for a role that has devices.</summary>
    public bool SendsDevices { get { return options.RoleName != Role.Observer; } }

    /// <summary>True when the connector waits for what a person decides.</summary>
    public bool NeedsPerson { get { return phase == ConnectorPhase.Failed || (phase == ConnectorPhase.Untrusted && Connector.View.Fingerprint != options.Trust); } }

    /// <summary>True when no session was joined, and none will be.</summary>
    public bool IsHopeless { get; private set; }

    /// <summary>Leave the session. Returns whether all threads have ended within the time that is promised.</summary>
    public bool Stop()
    {
        if (Connector != null) return Connector.Stop();
        bool hasEnded = Scene.Stop();
        return Client.Stop() && hasEnded;
    }

    public void Dispose()
    {
        Stop();
    }

    /// <summary>One frame of an app: take what came, send samples, wait for the next one.</summary>
    public void Frame()
    {
        long beganNs = MonotonicClock.NowNs;
        if (frameNs > 0 && beganNs - frameNs > 1_000_000_000) awakeNs = beganNs; // this process stood still
        frameNs = beganNs;
        Frames++;
        if (Connector != null && Connector.Poll()) TakeView(Connector.View);
        bool isSilent = phase == ConnectorPhase.Searching && options.Address.Length == 0 && options.PairingFile == null && beganNs - this.beganNs >= SilentNs;
        IsHopeless |= Client == null && (isSilent || phase == ConnectorPhase.Choosing);
        bool isNew = Client != null && Client.TakeState();
        Client?.TakePresence();
        while (Client != null && Client.TryTakeNews(out SessionNews one)) TakeNews(one);
        if (SendsSamples) SendSamples();
        LongestCallMs = Math.Max(LongestCallMs, (MonotonicClock.NowNs - beganNs) * 1e-6);
        if (isNew)
        {
            States++;
            long ageNs = Client.ToSessionNs(beganNs) - Client.State.SessionTimeNs;
            if (Ages.Count < 100_000) Ages.Add(ageNs * 1e-6);
            if (awakeNs >= 0 && ageNs < FreshNs)
            {
                RecoveryMs = (beganNs - awakeNs) * 1e-6;
                awakeNs = -1;
            }
        }
        Thread.Sleep(FrameMs);
    }

    private void ConnectByZmq(string run)
    {
        Hello hello = new Hello { Role = options.RoleName, Name = options.Name, Devices = new[] { Device.Head, Device.ControllerRight }, Capabilities = new[] { "run:" + run } };
        ZmqKeys keys = options.CurveKey.Length > 0 ? ZmqKeys.Read(options.CurveServer, options.CurveKey) : null;
        WebEndpoint endpoint = WebEndpoint.Parse((keys == null ? "http://" : "https://") + options.Zmq);
        FileIdentityStore identity = new FileIdentityStore(options.Identity);
        Client = new SessionClient(hello, identity, new EndpointChooser(endpoint), new ZmqTransport(keys));
        Scene = new SceneFetcher(Client, new AssetCache(new DiskAssetFiles(Path.Combine(options.Identity, "assets"))), SceneBudget.Quest3);
        Client.Start();
        Scene.Start();
    }

    /// <summary>Take and report what the connector does.</summary>
    private void TakeView(ConnectorView view)
    {
        if (view.Phase == ConnectorPhase.Idle) return;
        if (view.Pairing != null && view.Pairing != pairing) Write(view.Pairing);
        if (view.Phase != phase || view.Phrase.What != what)
        {
            List<string> names = new List<string>();
            foreach (OfferedSession one in view.Sessions) names.Add(one.Name + " (" + HostName.Format(one.Host, one.Port) + ")");
            string option = view.Phase == ConnectorPhase.Choosing ? " (--session NAME)" : view.Phase == ConnectorPhase.Untrusted ? " (--code CODE, or --trust FINGERPRINT)" : "";
            bool isOnItsWay = view.Phase == ConnectorPhase.Searching || view.Phase == ConnectorPhase.Pairing || view.Phase == ConnectorPhase.Running;
            report.Write(
                "find", isOnItsWay, "phase", view.Phase.ToString(), "session", view.Session, "endpoint", view.Endpoint, "text", view.Phrase + option, "sessions", names.ToArray());
        }
        phase = view.Phase;
        what = view.Phrase.What;
        if (Connector.Client != null)
        {
            Client = Connector.Client;
            Scene = Connector.Scene;
        }
        if (phase == ConnectorPhase.Untrusted && view.Fingerprint == options.Trust) Connector.Trust();
        bool isUnpaired = view.Pairing != null && view.Pairing.Outcome != PairingOutcome.Paired;
        bool isFault = view.Refusal == null && view.Problem.Failure == LinkFailure.None; // of what was given
        IsHopeless |= Client == null && phase == ConnectorPhase.Failed && (isUnpaired || isFault);
    }

    private void Write(PairingResult result)
    {
        pairing = result;
        string text = result.Outcome == PairingOutcome.Paired ? "" : LinkWords.OfPairing(result).ToString();
        report.Write(
            "pair", result.Outcome == PairingOutcome.Paired, "outcome", result.Outcome.ToString(), "code", result.Refusal == null ? "" : result.Refusal.Code, "failure", result.End.Failure.ToString(), "text", text,
            "roles", result.Roles);
    }

    /// <summary>Run frames until a condition holds. False: not within the time.</summary>
    public bool RunUntil(Func<bool> condition, double seconds = 60.0)
    {
        long untilNs = MonotonicClock.NowNs + (long)(seconds * 1e9);
        while (!condition())
        {
            if (IsInterrupted || IsHopeless || MonotonicClock.NowNs >= untilNs || (Client != null && Client.Crash.Length > 0)) return false;
            Frame();
        }
        return true;
    }

    /// <summary>Move the head at walking speed: one that is elsewhere from one frame to the next is a jump of the tracking.</summary>
    public void WalkTo(Double3 place)
    {
        Double3 from = T_world_head.Position;
        double durationNs = 1e9 * (0.3 + (place - from).Length / WalkingSpeed);
        long beganNs = MonotonicClock.NowNs;
        RunUntil(() =>
        {
            double share = Math.Min(1.0, (MonotonicClock.NowNs - beganNs) / durationNs);
            T_world_head = new RigidTransform(from + share * share * (3.0 - 2.0 * share) * (place - from), T_world_head.Rotation);
            return share >= 1.0;
        });
    }

    /// <summary>Ask the thread of the session how many samples could not be sent.</summary>
    public void CountUnsent()
    {
        bool isCounted = false;
        Client.Post(loop =>
        {
            Unsent = loop.Connection.Counters.SamplesNotSent;
            Volatile.Write(ref isCounted, true);
        });
        RunUntil(() => Volatile.Read(ref isCounted), 10.0);
    }

    /// <summary>Return the pose of a robot's end effector in the newest state.</summary>
    public bool TryGetSite(string robot, out RigidTransform T_world_site)
    {
        T_world_site = RigidTransform.Identity;
        SessionView view = Client.View;
        if (!view.Robots.TryGetValue(robot, out RobotInfo info) || Client.State.BodiesVersion != view.BodiesVersion) return false;
        for (int row = 0; row < view.Bodies.Length; row++)
        {
            if (view.Bodies[row].Id != info.SiteBody) continue;
            T_world_site = RigidTransform.FromRow(Client.State.Poses, row) * ToTransform(info.T_body_site);
            return true;
        }
        return false;
    }

    public static RigidTransform ToTransform(Pose pose)
    {
        return new RigidTransform(new Double3(pose.P[0], pose.P[1], pose.P[2]), new DoubleQuaternion(pose.Q[0], pose.Q[1], pose.Q[2], pose.Q[3]));
    }

    /// <summary>Return a pose in the tracking frame, with the tremble of what is measured.</summary>
    public RigidTransform ToTracking(RigidTransform T_world_device)
    {
        double tremble = 5e-5 * Math.Cos(Frames);
        RigidTransform pose = T_world_tracking.Inverse * T_world_device;
        return new RigidTransform(pose.Position + new Double3(tremble, 0, 0), pose.Rotation);
    }

    private void SendSamples()
    {
        long captureNs = Client.ToSessionNs(MonotonicClock.NowNs);
        head.CaptureNs = controller.CaptureNs = captureNs;
        head.Pose = ToTracking(T_world_head);
        controller.Pose = ToTracking(T_world_controller);
        controller.Clutch = Clutch;
        controller.Robots.Clear();
        controller.Robots.AddRange(Robots);
        Client.TrySendSample(head);
        Client.TrySendSample(controller);
    }

    private void TakeNews(SessionNews one)
    {
        if (one.Kind == NewsKind.Message && one.Message.Message is Feedback feedback)
        {
            Pulse pulse = Pulses.Take(feedback);
            if (feedback.ContactN > 0 && pulse.Intensity > ContactPulse.Intensity) ContactPulse = pulse;
        }
        else if (News.Count < 10_000) News.Add(one);
    }
}
