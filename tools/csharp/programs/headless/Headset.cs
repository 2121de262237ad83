using System;
using System.Collections.Generic;
using System.IO;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Storage;
using IrisSession.Transport;

/// <summary>A headset that is emulated: head and right controller in a tracking frame of its own, and a loop of frames at 72 Hz.</summary>
internal sealed class Headset : IDisposable
{
    public const int FrameMs = 14;
    private const long FreshNs = 100_000_000;
    private const double WalkingSpeed = 0.7; // m/s

    /// <summary>Where the tracking frame is: nothing about it is special.</summary>
    public static readonly RigidTransform T_world_tracking = new RigidTransform(
        new Double3(-0.4, 0.3, -0.75), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), 0.61));

    public readonly SessionClient Client;
    public readonly SceneFetcher Scene;
    public readonly List<SessionNews> News = new List<SessionNews>();
    public readonly Dictionary<string, Feedback> Feedbacks = new Dictionary<string, Feedback>();

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
    private readonly SampleInput head = new SampleInput { Device = Device.Head };
    private readonly SampleInput controller = new SampleInput { Device = Device.ControllerRight };
    private long frameNs;
    private long awakeNs = -1;

    public Headset(Options options, IIdentityStore identity, WebEndpoint[] endpoints)
    {
        string run = BitConverter.ToString(Guid.NewGuid().ToByteArray()).Replace("-", "").ToLowerInvariant();
        Hello hello = new Hello
        {
            Role = options.RoleName,
            Name = options.Name,
            Software = "iris-session headless",
            Devices = options.RoleName == Role.Observer ? new string[0] : new[] { Device.Head, Device.ControllerRight },
            Capabilities = new[] { "run:" + run },
        };
        Client = new SessionClient(hello, identity, new EndpointChooser(endpoints), new WebTransport());
        AssetCache cache = new AssetCache(new DiskAssetFiles(Path.Combine(options.Identity, "assets")));
        Scene = new SceneFetcher(Client, cache, SceneBudget.Quest3);
        Client.Start();
        Scene.Start();
    }

    /// <summary>Leave the session. Returns whether all threads have ended within the time that is promised.</summary>
    public bool Stop()
    {
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
        bool isNew = Client.TakeState();
        Client.TakePresence();
        while (Client.TryTakeNews(out SessionNews one)) TakeNews(one);
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

    /// <summary>Run frames until a condition holds. False: not within the time.</summary>
    public bool RunUntil(Func<bool> condition, double seconds = 60.0)
    {
        long untilNs = MonotonicClock.NowNs + (long)(seconds * 1e9);
        while (!condition())
        {
            if (IsInterrupted || MonotonicClock.NowNs >= untilNs || Client.Crash.Length > 0) return false;
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
        if (one.Kind == NewsKind.Message && one.Message.Message is Feedback feedback) Feedbacks[feedback.Robot] = feedback;
        else if (News.Count < 10_000) News.Add(one);
    }
}
