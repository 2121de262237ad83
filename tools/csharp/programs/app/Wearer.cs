using System;
using System.Collections.Generic;
using System.IO;
using System.Threading;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity;
using IrisSession.Unity.App;
using IrisSession.Unity.ArFoundation;
using IrisSession.Unity.Input;
using Standins;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.ARSubsystems;

/// <summary>A Quest 3 of stand-ins with the app on it, and its wearer: head and right controller move as a person's, sheets are where the session has them.</summary>
internal sealed class Wearer
{
    private const int FrameMs = 14;
    private const double WalkingSpeed = 0.7; // m/s

    /// <summary>A sheet is read from no farther [m].</summary>
    private const double ReadM = 1.2;

    /// <summary>Where the tracking frame is: nothing about it is special.</summary>
    private static readonly RigidTransform T_world_tracking = new RigidTransform(new Double3(-0.4, 0.3, -0.75), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), 0.61));

    public readonly IrisApp App;
    public readonly IrisHeadset Headset;
    public readonly IrisWorld World;
    public readonly Dictionary<string, Feedback> Feedbacks = new Dictionary<string, Feedback>();
    private readonly Dictionary<string, ARMarker> sheets = new Dictionary<string, ARMarker>();
    private readonly XROrigin origin;
    private Double3 head = new Double3(-0.6, 0.0, 0.6); // in the world, as the others
    private Double3 target = new Double3(0.4, 0.0, 0.4);
    private Double3 hand = new Double3(-0.2, -0.2, 0.5);
    private Double3 aim = new Double3(0.8, -0.2, 0.5);
    private int frames;

    public Wearer(string folder, string address, string name)
    {
        Engine.Reset();
        Directory.CreateDirectory(folder);
        UnityEngine.Application.PersistentDataPath = folder;
        GameObject offset = new GameObject("camera offset");
        App = offset.AddComponent<IrisApp>();
        App.Address = address;
        App.ParticipantName = name;
        Headset = offset.GetComponent<IrisHeadset>();
        World = offset.GetComponent<IrisWorld>();
        World.Materials.Surface = new UnityEngine.Material(new Shader("surface"));
        World.Materials.Points = new UnityEngine.Material(new Shader("points"));
        origin = new GameObject("origin").AddComponent<XROrigin>();
        origin.Trackables = new GameObject("trackables").transform;
        Subsystems.Loaded.Add(XRMarkerSubsystem.Make(XRMarkerType.QRCode));
        offset.AddComponent<IrisQuest>().SetUp(origin, origin.gameObject.AddComponent<ARMarkerManager>(), null);
        Headset.News += news =>
        {
            if (news.Kind == NewsKind.Message && news.Message.Message is Feedback feedback) Feedbacks[feedback.Robot] = feedback;
        };
    }

    public SessionClient Client { get { return App.Client; } }

    /// <summary>What the wearer reads before the eyes.</summary>
    public string Words { get { return Headset.Input == null ? App.Panel.Text : Headset.Panels.Urgent.Text; } }

    /// <summary>Run frames until a condition holds. False: not within the time.</summary>
    public bool RunUntil(Func<bool> condition, double seconds = 60)
    {
        for (long untilNs = MonotonicClock.NowNs + (long)(1e9 * seconds); !condition();)
        {
            if (MonotonicClock.NowNs >= untilNs) return false;
            Frame();
        }
        return true;
    }

    public void Set(string control, float value) { Controls.Set("<XRController>{RightHand}/" + control, value); }

    /// <summary>Walk to a place, and look at another one more and more.</summary>
    public void Walk(Double3 to, Double3 lookAt)
    {
        Double3 from = head, before = target;
        Glide(0.6 + (to - from).Length / WalkingSpeed, share =>
        {
            head = from + share * (to - from);
            target = before + share * (lookAt - before);
        });
    }

    /// <summary>Bring the hand to a place from which it points at another one.</summary>
    public void Point(Double3 from, Double3 at)
    {
        Double3 hadHand = hand, hadAim = aim;
        Glide(1.5, share =>
        {
            hand = hadHand + share * (from - hadHand);
            aim = hadAim + share * (at - hadAim);
        });
    }

    /// <summary>Move the hand as it is.</summary>
    public void Move(Double3 by)
    {
        Double3 hadHand = hand, hadAim = aim;
        Glide(2.0, share =>
        {
            hand = hadHand + share * by;
            aim = hadAim + share * by;
        });
    }

    /// <summary>Return where a robot's end effector is in the newest state, in the world.</summary>
    public bool TryGetSite(string robot, out Double3 p_world_site)
    {
        p_world_site = default;
        SessionView view = Client.View;
        StateFrame state = Client.State;
        if (!view.Robots.TryGetValue(robot, out RobotInfo info) || state.BodiesVersion != view.BodiesVersion) return false;
        for (int row = 0; row < view.Bodies.Length; row++)
        {
            if (view.Bodies[row].Id != info.SiteBody) continue;
            p_world_site = (RigidTransform.FromRow(state.Poses, row) * SceneDecoder.ToTransform(info.T_body_site)).Position;
            return true;
        }
        return false;
    }

    /// <summary>Return how far the alignment that was found is from the true one [m].</summary>
    public double MeasureAlignment()
    {
        Alignment found = Client.View.Alignment;
        return found == null ? double.NaN : (SceneDecoder.ToTransform(found.T_world_tracking).Inverse * T_world_tracking).Position.Length;
    }

    private void Glide(double seconds, Action<double> move)
    {
        long beganNs = MonotonicClock.NowNs;
        RunUntil(() =>
        {
            double share = Math.Min(1.0, (MonotonicClock.NowNs - beganNs) * 1e-9 / seconds);
            move(share * share * (3.0 - 2.0 * share));
            return share >= 1.0;
        }, seconds + 30);
    }

    private void Frame()
    {
        frames++;
        RigidTransform eyes = ToTracking(new RigidTransform(head, HeadsetPanels.Face(target, head)));
        Place("<XRHMD>/centerEye", "<XRHMD>/", "Position", "Rotation", eyes);
        RigidTransform grip = ToTracking(new RigidTransform(hand, HeadsetPanels.Face(aim, hand)));
        Place("<XRController>{RightHand}/device", "<XRController>{RightHand}/", "Position", "Rotation", grip);
        Place("<XRController>{RightHand}/pointer/", "<XRController>{RightHand}/pointer/", "position", "rotation", grip);
        if (Client != null) foreach (AnchorInfo anchor in Client.View.Anchors.Values) Show(anchor);
        Engine.Step(0.001 * FrameMs);
        Thread.Sleep(FrameMs);
    }

    private static void Place(string control, string device, string position, string rotation, RigidTransform pose)
    {
        Controls.Set(control + position, EnginePoses.ToEngine(pose.Position));
        Controls.Set(control + rotation, EnginePoses.ToEngine(pose.Rotation));
        Controls.Set(device + "isTracked", 1f);
        Controls.Set(device + "trackingState", 3);
    }

    /// <summary>Let the runtime report a sheet: its X to the right of one who reads it, its Y out of the sheet.</summary>
    private void Show(AnchorInfo anchor)
    {
        if (!sheets.TryGetValue(anchor.Id, out ARMarker marker))
        {
            sheets[anchor.Id] = marker = new GameObject("sheet").AddComponent<ARMarker>();
            marker.transform.SetParent(origin.Trackables, false);
            marker.Data = anchor.Id;
            marker.trackableId = new TrackableId(1, (ulong)sheets.Count);
        }
        RigidTransform T_world_anchor = SceneDecoder.ToTransform(anchor.T_world_anchor);
        RigidTransform pose = ToTracking(T_world_anchor);
        DoubleQuaternion turned = pose.Rotation * DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), Math.PI / 2);
        marker.transform.SetPositionAndRotation(EnginePoses.ToEngine(pose.Position), EnginePoses.ToEngine(turned));
        marker.size = new Vector2((float)anchor.SizeM, (float)anchor.SizeM);
        marker.trackingState = (T_world_anchor.Position - head).Length <= ReadM ? TrackingState.Tracking : TrackingState.Limited;
    }

    /// <summary>Return a pose in the tracking frame, with the tremble of what is measured.</summary>
    private RigidTransform ToTracking(RigidTransform T_world_device)
    {
        RigidTransform pose = T_world_tracking.Inverse * T_world_device;
        return new RigidTransform(pose.Position + new Double3(5e-5 * Math.Cos(frames), 0, 0), pose.Rotation);
    }
}
